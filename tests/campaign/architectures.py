"""Shapes that cases are drawn from: each new one is compiled, so there are few of them.

Everything else of a case (weights, scales, numbers of sets, faults, thresholds) is free. Together
they cover 1 to 13 states, 0 to 3 hidden layers, every kind of set, template, relaxation and window.
"""

from dataclasses import dataclass

from tests.campaign.kinds import KINDS, Kind

LOCAL = (
    "rj.LocalBounds()",
    "rj.LocalBounds(repeated=False)",
    "rj.LocalBounds(remove_stable=False)",
)
PAPER = ("rj.PaperQC()", "rj.PaperQC(repeated=False)", "rj.PaperQC(remove_stable=True)")
CUTS = ("rj.CuttingPlanes()", "rj.CuttingPlanes(rounds=2, batch=5)")
ALL = ("rj.AllProducts()",)


@dataclass(frozen=True)
class Architecture:
    """What decides the shapes of a case.

    Attributes:
        name: of the architecture; that of the loop's shapes first.
        states: of the plant.
        hidden: neurons of each hidden layer.
        inputs: of the plant.
        boxed: whether inputs are projected onto a box.
        varying: which of `A`, `B`, `c` and `u` (the input box) have a time axis.
        region: the kind of initial set.
        facets: of a polytope.
        template: the expression of the template; `{facets}` and such are filled in.
        relaxations: expressions to choose from.
        windows: to choose from.
        horizon: the number of steps.
        interior: whether the interior-point method, which compiles for long, is among the solvers.
        gradients: whether derivatives are compared with differences.
    """

    name: str
    states: int
    hidden: tuple[int, ...]
    inputs: int
    boxed: bool
    region: str
    template: str
    relaxations: tuple[str, ...]
    windows: tuple[int | None, ...] = (1,)
    horizon: int = 2
    varying: str = ""
    facets: int = 0
    interior: bool = False
    gradients: bool = False

    @property
    def loop(self) -> tuple:
        """What cases must share for the compiled code of their loops to be the same."""
        return self.states, self.hidden, self.inputs, self.boxed, self.varying


SMALL = {"states": 2, "hidden": (3,), "inputs": 1, "boxed": True}
DEEP = {"states": 2, "hidden": (2, 2), "inputs": 1, "boxed": False}
LINEAR = {"states": 2, "hidden": (), "inputs": 1, "boxed": False}
VARYING = {"states": 2, "hidden": (), "inputs": 1, "boxed": True, "varying": "Acu"}
SPACE = {"states": 3, "hidden": (4,), "inputs": 2, "boxed": True}
SIX = {"states": 6, "hidden": (3,), "inputs": 2, "boxed": True}
LINE = {"states": 1, "hidden": (2,), "inputs": 1, "boxed": True}
FOUR = {"states": 4, "hidden": (2,), "inputs": 2, "boxed": False, "varying": "ABc"}
BOX, BALL = "rj.Template.box({n})", "rj.EllipsoidTemplate()"
SHAPED = "rj.EllipsoidTemplate({shape})"

ARCHITECTURES = (
    # the default number of cases takes half a block of each of these eight
    Architecture("small, box", **SMALL, region="box", template=BOX, relaxations=LOCAL + PAPER),
    Architecture(
        "small, polytope",
        **SMALL,
        region="polytope",
        facets=6,
        template="rj.Template.regular(5)",
        relaxations=LOCAL + PAPER,
    ),
    Architecture(
        "small, ball to ball",
        **SMALL,
        region="ellipsoid",
        template=BALL,
        relaxations=LOCAL + PAPER,
    ),
    Architecture(
        "small, both",
        **SMALL,
        region="intersection",
        template=f"rj.MixedTemplate({BOX})",
        relaxations=LOCAL,
    ),
    Architecture(
        "line, linear",
        1,
        (),
        1,
        False,
        region="box",
        template=BOX,
        relaxations=CUTS + ALL,
        windows=(2, None),
    ),
    Architecture(
        "varying, saturated",
        **VARYING,
        region="box",
        template=BOX,
        relaxations=CUTS,
        windows=(1,),
    ),
    Architecture(
        "three layers",
        3,
        (2, 2, 2),
        1,
        False,
        region="box",
        template=BOX,
        relaxations=CUTS,
        windows=(2,),
    ),
    Architecture(
        "line, gradients",
        **LINE,
        region="box",
        template=BOX,
        relaxations=("rj.LocalBounds()",),
        gradients=True,
    ),
    # the others
    Architecture(
        "linear, octagonal",
        **LINEAR,
        region="polytope",
        facets=6,
        template="rj.Template.octagonal({n})",
        relaxations=CUTS + ALL,
        windows=(None,),
    ),
    Architecture("small, to ball", **SMALL, region="box", template=BALL, relaxations=LOCAL + PAPER),
    Architecture("small, ball", **SMALL, region="ellipsoid", template=BOX, relaxations=LOCAL),
    Architecture("six", **SIX, region="ellipsoid", template=BOX, relaxations=LOCAL, horizon=1),
    Architecture(
        "space, shaped",
        **SPACE,
        region="box",
        template=SHAPED,
        relaxations=LOCAL + PAPER,
        horizon=1,
    ),
    Architecture(
        "small, adapted",
        **SMALL,
        region="box",
        template="rj.Template.adapted(loop, X0, {horizon}, 6, start={start}, samples=50)",
        relaxations=CUTS + ALL,
        windows=(1, 2, None),
    ),
    Architecture(
        "deep, both",
        **DEEP,
        region="intersection",
        template=f"rj.MixedTemplate({BOX})",
        relaxations=LOCAL,
    ),
    Architecture(
        "small, interior",
        **SMALL,
        region="box",
        template=BOX,
        relaxations=LOCAL,
        interior=True,
    ),
    Architecture(
        "small, mixed",
        **SMALL,
        region="intersection",
        template=f"rj.MixedTemplate(rj.Template.octagonal({{n}}), {SHAPED})",
        relaxations=CUTS + LOCAL,
        windows=(1, 2),
    ),
    Architecture(
        "deep, long",
        **DEEP,
        region="polytope",
        facets=5,
        template=BOX,
        relaxations=CUTS + ALL,
        windows=(1, 2, 3, None),
        horizon=3,
    ),
    Architecture(
        "deep, ball to ball",
        **DEEP,
        region="ellipsoid",
        template=SHAPED,
        relaxations=LOCAL + PAPER,
        interior=True,
    ),
    Architecture(
        "varying, ball",
        **VARYING,
        region="ellipsoid",
        template=BOX,
        relaxations=PAPER + CUTS,
        windows=(1, 2, None),
    ),
    Architecture(
        "linear, balls",
        **LINEAR,
        region="ellipsoid",
        template=BALL,
        relaxations=LOCAL + CUTS,
        windows=(1, None),
    ),
    Architecture(
        "space, polytope",
        **SPACE,
        region="polytope",
        facets=8,
        template=BOX,
        relaxations=CUTS,
        windows=(1, None),
    ),
    Architecture(
        "space, octagonal",
        **SPACE,
        region="intersection",
        template="rj.Template.octagonal({n})",
        relaxations=LOCAL,
        horizon=1,
    ),
    Architecture(
        "four, varying",
        **FOUR,
        region="polytope",
        facets=10,
        template=BOX,
        relaxations=LOCAL + PAPER,
    ),
    Architecture("six, box", **SIX, region="box", template=BALL, relaxations=LOCAL, horizon=1),
    Architecture(
        "line, all",
        **LINE,
        region="box",
        template=BOX,
        relaxations=ALL + CUTS + PAPER,
        windows=(1, 2, None),
        horizon=3,
        interior=True,
    ),
    Architecture(
        "wide",
        2,
        (8, 8),
        1,
        True,
        region="box",
        template=BOX,
        relaxations=("rj.LocalBounds(repeated=False)", "rj.CuttingPlanes(rounds=2)"),
        horizon=1,
    ),
    Architecture(
        "thirteen, linear",
        13,
        (),
        1,
        False,
        region="box",
        template=BOX,
        relaxations=LOCAL,
        horizon=1,
    ),
    Architecture(
        "deep, balls",
        **DEEP,
        region="ellipsoid",
        template=BALL,
        relaxations=CUTS + ALL,
        windows=(1, 2, None),
    ),
)

BLOCK = 25
"""So many consecutive cases share an architecture."""

QUICK, QUICK_KINDS = 8, 4
EVERY = (
    *ARCHITECTURES[:QUICK],
    *KINDS[:QUICK_KINDS],
    *ARCHITECTURES[QUICK:],
    *KINDS[QUICK_KINDS:],
)
"""Chains of ReLUs under affine plants, and loops of every other kind."""


def architecture(number: int) -> Architecture | Kind:
    """That of a case."""
    return EVERY[number // BLOCK % len(EVERY)]
