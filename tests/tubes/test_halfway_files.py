"""A verdict by a set that states come into halfway is proved anew from both parts, or refused."""

import copy
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import reachjax as rj
from reachjax.tubes.saving import keep
from reachjax.verdicts import rechecks
from reachjax.verdicts.grounds import Asked, Closing, Grounds
from reachjax.verdicts.halfway import ARRIVES, Halfway
from reachjax.verdicts.specification import period_of, requirements
from reachjax.verdicts.verdict import KeptVerdict, VerdictStatus
from tests.tubes.test_closing import STILL, X0, turning
from tests.tubes.test_hostile_files import CHANGES, REFUSED, opened, written

HORIZON, FIRST = 120, 100
"""What is required speaks of the last steps only."""

LATER = 300
"""Steps of simulation, beyond the horizon."""

SMALL = rj.Box([-0.01, -0.01], [0.01, 0.01])
CLOSE = rj.Box([-0.008, -0.008], [0.008, 0.008])
"""A set that states are in after 45 steps and again after ten, if they shrink by a tenth."""

LATE = {range(FIRST, HORIZON + 1): SMALL}


def slowed(growth=-1.0):
    """A differential equation with a function of the user, of which a file has but the seal."""

    def f(x, u):
        return jnp.array([growth * x[0] + x[1], -x[0] + growth * x[1] + u[0]])

    return rj.ClosedLoop(rj.SampledPlant(f, 2, 1, 0.1), STILL)


@pytest.fixture(scope="module")
def discrete():
    return rj.decide(turning(0.9), X0, HORIZON, goal=LATE)


@pytest.fixture(scope="module")
def sampled():
    return rj.decide(slowed(), X0, HORIZON, goal={(10.0, 12.0): SMALL})


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.verdict"


def by_hand(loop, begun, step, region, period, horizon=HORIZON, **required):
    """A verdict that is said to be proved by a set."""
    items = requirements(loop.states, horizon, period_of(loop), **required)
    asked = Asked(loop, begun, horizon, 0, tuple(items))
    grounds = Closing(step, region, period, Grounds(), Grounds())
    return rj.Verdict(VerdictStatus.PROVED, {}, {}, asked=asked, grounds=grounds)


def same_margins(verdict, again):
    for name, margins in verdict.margins.items():
        known = ~np.isnan(margins)
        assert np.array_equal(known, ~np.isnan(again.margins[name]))
        assert np.allclose(margins[known], again.margins[name][known], rtol=0, atol=1e-9)


@pytest.mark.parametrize("kind", ["discrete", pytest.param("sampled", marks=pytest.mark.costly)])
def test_what_rests_on_a_set_halfway_is_proved_anew(kind, path, request, monkeypatch):
    verdict = request.getfixturevalue(kind)
    assert verdict.proved
    found = verdict.recurrence
    assert found.step + found.period < FIRST
    verdict.save(path)

    def refuse(*_, **__):
        raise AssertionError("something was searched")

    monkeypatch.setattr("reachjax.solvers.linear_programs.LinearPrograms.largest", refuse)
    monkeypatch.setattr("reachjax.methods.ladder.Ladder.bounds", refuse)
    loop = verdict.asked.loop
    assert rj.load(path, loop).recurrence is None  # nothing was asked
    again = rj.load(path, loop, recheck=True)
    assert again.proved
    same_margins(verdict, again)
    assert (again.recurrence.step, again.recurrence.period) == (found.step, found.period)
    assert again.recurrence.margin == pytest.approx(found.margin, abs=1e-9)
    np.testing.assert_array_equal(again.recurrence.region.upper, found.region.upper)
    again.save(path)
    assert rj.load(path, loop, recheck=True).proved


def test_what_is_proved_by_cells_until_the_set_is_proved_anew(path):
    """And what is required as long as states are on their way, at all times of it."""
    wide = rj.Box([-0.42, -0.42], [0.42, 0.42])
    verdict = rj.decide(turning(0.9), X0, HORIZON, safe=wide, goal=LATE, cells=[2, 1])
    assert verdict.proved
    assert isinstance(verdict.grounds, Closing)
    verdict.save(path)
    same_margins(verdict, rj.load(path, recheck=True))


def test_a_proof_from_the_set_until_the_horizon_says_nothing_of_later_times(path, monkeypatch):
    monkeypatch.setattr("reachjax.verdicts.closing.periods", lambda loop, candidate: [])
    verdict = rj.decide(turning(0.9), X0, HORIZON, goal=LATE, cells=[1, 1])
    assert verdict.proved
    assert verdict.grounds.period == 0
    verdict.save(path)
    again = rj.load(path, recheck=True)
    same_margins(verdict, again)
    assert again.recurrence is None


def test_a_set_may_be_halfway_to_another_one():
    """The outer one holds until the horizon, by an inner one that is come back to."""
    R, S = (rj.Box([-size, -size], [size, size]) for size in (0.1, 0.008))
    outer = by_hand(turning(0.9), X0, 25, R, 0, goal=LATE)
    inner = Closing(40, S, 10, Grounds(), Grounds())
    again = rechecks.rechecked(
        rj.Verdict(
            VerdictStatus.PROVED,
            {},
            {},
            asked=outer.asked,
            grounds=outer.grounds._replace(after=inner),
        )
    )
    assert again.proved
    assert (again.recurrence.step, again.recurrence.period) == (65, 10)
    assert again.recurrence.region is S


@pytest.mark.parametrize("right", [True, False], ids=["right", "wrong"])
def test_a_command_rechecks_both_parts(right, discrete, path):
    discrete.save(path)
    if not right:
        edited(path, with_a_smaller_set)
    command = [sys.executable, "-m", "reachjax", "recheck", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == (0 if right else 1)
    expected = "for ever: in a set at t = " if right else "error: "
    assert expected in (done.stdout if right else done.stderr)


# files that differ from an honest one in one thing ------------------------------------------------


def edited(path, change):
    """The same file with one thing changed."""
    head, arrays = opened(path)
    asked, _, _, grounds = head["value"]["parts"][0]["parts"]
    change(asked["parts"], grounds["parts"], arrays)
    written(path, head, arrays)


def required_in(asked):
    return asked[4]["tuple"]


def scaled(box, by, arrays):
    """Another box in place of one."""
    for end in box["fields"].values():
        arrays.append(by * arrays[end["array"]])
        end["array"] = len(arrays) - 1


def named(name, time=None):
    def change(asked, grounds, arrays):
        fields = required_in(asked)[0]["fields"]
        fields["name"] = name
        scaled(fields["region"], 1e-9, arrays)  # which is false
        fields["time"] = fields["time"] if time is None else time(grounds)

    return change


def with_the_same_twice(asked, grounds, arrays):
    required_in(asked).append(copy.deepcopy(required_in(asked)[0]))


def with_another_set_at_one_time(asked, grounds, arrays):
    required_in(asked).append(copy.deepcopy(required_in(asked)[0]))
    scaled(required_in(asked)[-1]["fields"]["region"], 2.0, arrays)


def with_a_smaller_goal(asked, grounds, arrays):
    scaled(required_in(asked)[-1]["fields"]["region"], 1e-9, arrays)


def with_an_earlier_goal(asked, grounds, arrays):
    required_in(asked)[0]["fields"]["time"] = 3


def with_a_goal_before_the_set(asked, grounds, arrays):
    required_in(asked)[0]["fields"]["time"] = grounds[0] - 20


def with_a_smaller_set(asked, grounds, arrays):
    scaled(grounds[1], 1e-3, arrays)


def with_a_larger_set(asked, grounds, arrays):
    scaled(grounds[1], 1e3, arrays)


def with_a_larger_initial_set(asked, grounds, arrays):
    scaled(asked[1], 1e3, arrays)


def with_step(step):
    def change(asked, grounds, arrays):
        grounds[0] = step

    return change


def with_period(period):
    def change(asked, grounds, arrays):
        grounds[2] = period

    return change


def without_cells(part):
    def change(asked, grounds, arrays):
        grounds[part]["parts"][2] = {"tuple": []}

    return change


def with_half_of_the_cells(part):
    def change(asked, grounds, arrays):
        grounds[part]["parts"][1] = {"tuple": [{"tuple": [0, -1]}]}

    return change


def with_fewer_roots(part):
    def change(asked, grounds, arrays):
        grounds[part]["parts"][0] = {"tuple": [2, 1]}

    return change


def varying(plant, grounds, arrays):
    """Another affine plant: the same as long as the proof looks at it, and growing later."""
    last = grounds[0] + grounds[2] + 1
    for name in "ABc":
        place = plant["fields"][name]
        kept, grows = arrays[place["array"]], 1.5 if name == "A" else 1.0
        arrays.append(np.stack([kept] * last + [grows * kept] * (2 * HORIZON - last)))
        place["array"] = len(arrays) - 1


def with_a_plant_that_varies(asked, grounds, arrays):
    varying(asked[0]["fields"]["plant"], grounds, arrays)


def with_a_delayed_plant_that_varies(asked, grounds, arrays):
    varying(asked[0]["fields"]["plant"]["fields"]["plant"], grounds, arrays)


FORGED = {
    "called halfway": named(ARRIVES),
    "called halfway, then": named(ARRIVES, lambda grounds: grounds[0]),
    "called halfway, back": named(ARRIVES, lambda grounds: grounds[2]),
    "called as later": named("goal, 0"),
    "called as again": named("goal, True"),
    "called nothing": named(""),
    "called in other letters": named("Goal"),
    "called in two lines": named("goal\n"),
    "avoid without a number": named("avoid["),
    "avoid with two numbers": named("avoid[0][1]"),
    "the same twice": with_the_same_twice,
    "another set at one time": with_another_set_at_one_time,
    "a smaller goal": with_a_smaller_goal,
    "an earlier goal": with_an_earlier_goal,
    "a goal before the set": with_a_goal_before_the_set,
    "a smaller set": with_a_smaller_set,
    "a larger set": with_a_larger_set,
    "a larger initial set": with_a_larger_initial_set,
    **{f"step {step}": with_step(step) for step in (-1, 0, 1, HORIZON - 1, HORIZON, 2**40)},
    **{f"step {step!r}": with_step(step) for step in (49.0, "49", None)},
    **{f"period {period}": with_period(period) for period in (-1, 1, 2, 2**40)},
    "no cells before": without_cells(3),
    "no cells after": without_cells(4),
    "half of the cells before": with_half_of_the_cells(3),
    "half of the cells after": with_half_of_the_cells(4),
    "more cells after": with_fewer_roots(4),
}


@pytest.mark.parametrize("change", FORGED.values(), ids=FORGED)
def test_a_file_that_says_something_else_is_refused(change, discrete, path):
    discrete.save(path)
    edited(path, lambda asked, grounds, arrays: None)
    assert rj.load(path, recheck=True).proved
    edited(path, change)
    with pytest.raises(REFUSED):
        rj.load(path, recheck=True)


def test_names_of_steps_of_proofs_are_refused_without_a_recheck(discrete, path):
    discrete.save(path)
    edited(path, named(ARRIVES))
    with pytest.raises(rj.UnreadableError, match="is no part of a specification"):
        rj.load(path)


def test_what_a_set_need_not_be_come_back_to_is_not_for_ever(path):
    by_hand(turning(0.9), X0, 45, CLOSE, 10, goal=LATE).save(path)
    assert rj.load(path, recheck=True).recurrence.period == 10
    edited(path, with_period(0))
    again = rj.load(path, recheck=True)
    assert again.proved
    assert again.recurrence is None


def test_no_two_requirements_of_a_part_have_one_name_and_time(discrete):
    """Whoever asks: one of them would be taken for proved with the other."""
    asked, step = discrete.asked, discrete.grounds.step
    also = rj.verdicts.specification.Requirement(ARRIVES, step, SMALL, True)
    with pytest.raises(ValueError, match="the same is required twice"):
        Halfway(asked._replace(required=(*asked.required, also)), step, SMALL, 5)


@pytest.mark.parametrize(("step", "period"), [(0, 5), (HORIZON, 5), (50, -1)])
def test_steps_and_periods_are_within_the_horizon(step, period, discrete):
    with pytest.raises(ValueError, match=f"step {step} and period {period} are not of 120 steps"):
        Halfway(discrete.asked, step, SMALL, period)


def delayed():
    loop = rj.delayed(turning(0.9))
    R = rj.Box([-0.03, -0.03, -1e-3], [0.03, 0.03, 1e-3])
    around = rj.Box([-0.06, -0.06, -0.06], [0.06, 0.06, 0.06])
    late = {range(FIRST, HORIZON + 1): around}
    return by_hand(loop, rj.with_inputs(X0, [0.0]), 40, R, 15, goal=late)


@pytest.mark.parametrize("late", [False, True], ids=["plant", "delayed plant"])
@pytest.mark.parametrize("period", [True, False], ids=["for ever", "until the horizon"])
def test_a_plant_that_varies_is_not_closed(late, period, path):
    """Of a delayed one it is the plant that says so: `delayed` makes none, but a file may."""
    verdict = delayed() if late else by_hand(turning(0.9), X0, 45, CLOSE, 10, goal=LATE)
    verdict.save(path)
    if not period:
        edited(path, with_period(0))
    assert rj.load(path, recheck=True).proved
    edited(path, with_a_delayed_plant_that_varies if late else with_a_plant_that_varies)
    loop = rj.load(path).asked.loop
    ends = np.asarray(loop.simulate(verdict.asked.X0.corners(), HORIZON))[:, FIRST:]
    assert not np.asarray(verdict.asked.required[-1].region.contains(ends)).all()
    with pytest.raises(rj.DisagreementError, match="varies in time"):
        rj.load(path, recheck=True)


def knowing_the_time():
    """A plant that is `turning(0.9)` until a step at which no proof looks, and grows later."""
    c, s = np.cos(0.3), np.sin(0.3)

    def f(x, u, t):
        return jnp.where(t < 60, 0.9, 1.5) * (jnp.array([[c, -s], [s, c]]) @ x) + 0 * u[0]

    return f


@pytest.mark.parametrize("clock", [False, True])
def test_a_plant_that_knows_the_time_is_not_closed_for_ever(clock):
    f = knowing_the_time()
    plant = rj.NonlinearPlant.timed(f, 2, 1) if clock else turning(0.9).plant
    loop = turning(0.9).replace(plant=plant)
    verdict = by_hand(loop, X0, 45, CLOSE, 10, goal=LATE)
    if not clock:
        assert rechecks.rechecked(verdict).proved
        return
    with pytest.raises(rj.DisagreementError, match="varies in time"):
        rechecks.rechecked(verdict)


QUARTERS = rj.ClosedLoop(rj.AffinePlant([[0.0, -0.99], [0.99, 0.0]], [[0.0], [1.0]]), STILL)
"""A long set lies along one axis after even steps, and along the other one after odd ones."""


@pytest.mark.parametrize("time", [FIRST, FIRST + 1], ids=["even", "odd"])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_breaks_at_one_step_of_the_period_is_refused(axis, time):
    """From the set on until the horizon it is proved at the steps at which it is true."""
    begun, R = rj.Box([0.3, -0.01], [0.4, 0.01]), rj.Box([-0.5, -0.05], [0.5, 0.05])
    normal = np.eye(2)[axis]
    narrow = rj.Polytope([normal, -normal], [0.1, 0.1])
    for period in (0, 2, 4):
        verdict = by_hand(QUARTERS, begun, 26, R, period, goal={time: narrow})
        if period == 0 and axis != time % 2:
            again = rechecks.rechecked(verdict)
            assert again.margins["goal"][time] == pytest.approx(0.1 - 0.05 * 0.99 ** (time - 26))
        else:
            with pytest.raises(rj.DisagreementError):
                rechecks.rechecked(verdict)


def revolving():
    """Samples see one turn after the other end near where it began; in between it is elsewhere."""
    A = np.array([[-0.01, 2 * np.pi], [-2 * np.pi, -0.01]])
    plant = rj.SampledPlant.affine(A, np.array([[0.0], [0.0]]), period=1.0)
    return rj.ClosedLoop(plant, STILL)


@pytest.mark.costly
def test_what_is_meant_in_between_samples_is_proved_in_between_them(path):
    loop, begun = revolving(), rj.Box([0.3, -0.01], [0.4, 0.01])
    R, flat = rj.Box([-0.5, -0.05], [0.5, 0.05]), rj.Polytope([[0.0, 1.0], [0.0, -1.0]], [0.1, 0.1])
    verdict = by_hand(loop, begun, 25, R, 1, goal={range(FIRST, HORIZON + 1): flat})
    verdict.save(path)
    assert rj.load(path, recheck=True).proved

    def at_all_times(asked, grounds, arrays):
        required_in(asked)[-1]["fields"]["throughout"] = True

    edited(path, at_all_times)
    assert rj.load(path).asked.required[-1].throughout
    with pytest.raises(rj.DisagreementError):
        rj.load(path, recheck=True)
    ball = rj.Box([-0.6, -0.6], [0.6, 0.6])
    by_hand(loop, begun, 25, R, 1, safe=ball).save(path)
    assert rj.load(path, recheck=True).proved

    def at_samples(asked, grounds, arrays):
        required_in(asked)[-1]["fields"]["throughout"] = False

    edited(path, at_samples)
    with pytest.raises(rj.UnreadableError, match="in between samples"):
        rj.load(path, recheck=True)


@pytest.mark.costly
def test_what_is_meant_in_between_at_one_late_time_is_proved_in_between_at_all_of_them():
    """At the other ones samples will do, but the later states may be those of any of them."""
    loop, begun = revolving(), rj.Box([0.3, -0.01], [0.4, 0.01])
    R, flat = rj.Box([-0.5, -0.05], [0.5, 0.05]), rj.Polytope([[0.0, 1.0], [0.0, -1.0]], [0.1, 0.1])
    late = {range(FIRST, HORIZON - 1): flat, (HORIZON - 1.0, HORIZON - 0.0): flat}
    with pytest.raises(rj.DisagreementError):
        rechecks.rechecked(by_hand(loop, begun, 25, R, 1, goal=late))


@pytest.mark.costly
def test_a_file_without_its_loop_takes_no_other_one(sampled, path):
    sampled.save(path)
    with pytest.raises(rj.UnreadableError, match="give the loop again"):
        rj.load(path, recheck=True)
    with pytest.raises(ValueError, match="loop must be that of the tube"):
        rj.load(path, slowed(0.5), recheck=True)


def test_a_file_of_another_loop_is_not_taken_for_that_of_a_seal(discrete, path):
    kept = KeptVerdict(discrete.asked, discrete.status, None, discrete.grounds)
    keep(path, kept, turning(1.1))
    for recheck in (False, True):
        with pytest.raises(ValueError, match="loop must be that of the tube"):
            rj.load(path, turning(1.1), recheck=recheck)


def test_a_growing_loop_is_proved_by_no_set_step_and_period():
    """A spiral breaks what is required at the end, whatever a file says is halfway."""
    rng, loop = np.random.default_rng(0), turning(1.01)
    safe = rj.Box(*(sign * np.full(2, 0.4 * 1.01**HORIZON + 0.1) for sign in (-1, 1)))
    for _ in range(15):
        center, radii = 0.3 * rng.normal(size=2), rng.exponential(size=2)
        region = rj.Box(center - radii, center + radii)
        step, period = (int(rng.integers(first, 60)) for first in (1, 0))
        verdict = by_hand(loop, X0, step, region, period, horizon=200, safe=safe)
        with pytest.raises(rj.DisagreementError):
            rechecks.rechecked(verdict)


@pytest.mark.costly
@pytest.mark.parametrize("change", CHANGES, ids=lambda change: change.__name__)
def test_a_file_that_was_changed_is_refused_or_says_what_is_true(change, discrete, tmp_path):
    discrete.save(tmp_path / "whole")
    rng = np.random.default_rng(len(change.__name__))
    for _ in range(12):
        head, arrays = opened(tmp_path / "whole")
        change(rng, head, arrays)
        try:
            written(tmp_path / "changed", head, arrays)
        except (TypeError, ValueError, AttributeError, KeyError):
            continue  # it cannot be written so
        try:
            again = rj.load(tmp_path / "changed", recheck=True)
        except REFUSED:
            continue
        if again.proved:
            require_true(again)


def require_true(verdict):
    """No simulated state breaks what a verdict says, for ever if it says so."""
    asked, found = verdict.asked, verdict.recurrence
    begun = jnp.concatenate([asked.X0.corners(), asked.X0.sample(jax.random.key(1), 200)])
    runs = np.asarray(asked.loop.simulate(begun, max(LATER, asked.horizon)))
    for item in asked.required:
        assert item.simulated(runs).min() >= -1e-9
    if found is not None:
        last = max(item.time for item in asked.required)
        for item in (item for item in asked.required if item.time == last):
            beyond = runs[:, last:]
            assert np.asarray(item.region.contains(beyond, 1e-9)).all() is np.bool_(item.inside)
