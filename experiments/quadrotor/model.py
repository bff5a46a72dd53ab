"""The 6-D quadrotor of Hu, Fazlyab, Morari, Pappas (CDC 2020), section V-B, and its task.

The state is `x = [p_x, p_y, p_z, v_x, v_y, v_z]`, in metres and metres per second. With the input
`u = [tan(theta), tan(phi), tau]`, of pitch, roll and thrust (an acceleration), the dynamics are
affine (the paper's eq. quad):

    dp/dt = v,   dv_x/dt = g tan(theta),   dv_y/dt = -g tan(phi),   dv_z/dt = tau - g .

The tangent increases, so limits on the angles are limits on `u`. Within one second all states of
the initial set are to reach the goal, which is a box of positions, within position limits.

The paper's velocity limits `|v| <= 1` contradict its goal: `p_y` starts at 4.7 and within one
second would not come below 3.65, while the goal asks for 3.5. So they are left out, unless they are
asked for; then the goal is.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

import reachjax as rj

GRAVITY = 9.81
PERIOD = 0.1
"""Seconds between two decisions."""
STEPS = 10
"""Decisions until the goal must be reached."""
INITIAL_CENTER = np.array([4.7, 4.7, 3.0, 0.95, 0.0, 0.0])
INITIAL_RADII = np.array([0.05, 0.05, 0.05, 0.01, 0.01, 0.01])
GOAL = np.array([[3.7, 2.5, 1.2], [4.1, 3.5, 2.6]])
POSITION_LIMITS = np.array([[-5.0, -5.0, -5.0], [5.0, 5.0, 5.0]])
VELOCITY_LIMITS = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
ANGLE_LIMIT = np.pi / 9
INPUT_LIMITS = np.array(
    [[-np.tan(ANGLE_LIMIT), -np.tan(ANGLE_LIMIT), 0], [np.tan(ANGLE_LIMIT)] * 2 + [2 * GRAVITY]]
)
"""Of `tan(theta)`, `tan(phi)` and `tau`."""
INPUT_NAMES = ("tan(theta)", "tan(phi)", "tau")
AXES = ("p_x", "p_y", "p_z")
"""Names of the positions."""


def continuous_plant() -> tuple[Float[ndarray, "6 6"], Float[ndarray, "6 3"], Float[ndarray, " 6"]]:
    """`A`, `B`, `c` of `dx/dt = A x + B u + c`."""
    A, B, c = np.zeros((6, 6)), np.zeros((6, 3)), np.zeros(6)
    A[:3, 3:] = np.eye(3)
    B[3:] = np.diag([GRAVITY, -GRAVITY, 1])
    c[5] = -GRAVITY
    return A, B, c


def plant() -> rj.AffinePlant:
    """The plant with its input held over each period."""
    return rj.zero_order_hold(*continuous_plant(), period=PERIOD)


def initial_set() -> rj.Ellipsoid:
    """The paper's `X_0`: its shape matrix is that of the inverse of the quadratic form."""
    return rj.Ellipsoid(INITIAL_CENTER, np.diag(INITIAL_RADII**2))


def loop_with(layers) -> rj.ClosedLoop:
    """The sampled plant under a network, its output projected onto the actuator limits."""
    return rj.ClosedLoop(plant(), rj.MLP.from_layers(layers), rj.Box(*INPUT_LIMITS))


def goal_set() -> rj.Polytope:
    """All states whose position is in the goal."""
    return _positions(GOAL)


def safe_set(velocity_limits: bool) -> rj.PolyhedralSet:
    """All states within the position limits, and within the velocity limits if they are kept."""
    if velocity_limits:
        return rj.Box(*np.hstack([POSITION_LIMITS, VELOCITY_LIMITS]))
    return _positions(POSITION_LIMITS)


def _positions(box: Float[ndarray, "2 3"]) -> rj.Polytope:
    """The states with a position in a box, whatever their velocity: six facets, unbounded."""
    rows = np.eye(3, 6)
    return rj.Polytope(np.vstack([-rows, rows]), np.concatenate([-box[0], box[1]]))
