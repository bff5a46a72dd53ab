"""A budget is one clock and one purse, and so are all parts of it."""

import pickle
import time

import numpy as np
import pytest

from reachjax.numerics.budget import ENDLESS, Budget


def test_no_limit_is_never_over():
    budget = Budget.of(None)
    assert not budget.late
    assert not budget.timed
    assert budget.limit is None
    assert budget.share(0.1).left == np.inf
    assert not ENDLESS.late


def test_a_limit_of_zero_is_over_at_once():
    budget = Budget.of(0)
    assert budget.late
    assert budget.timed
    assert budget.limit == 0.0


@pytest.mark.parametrize(
    ("limit", "error"), [("1", TypeError), (-1, ValueError), (np.nan, ValueError)]
)
def test_what_is_no_limit_is_refused(limit, error):
    with pytest.raises(error, match="time_limit must be"):
        Budget.of(limit)


def test_a_share_ends_sooner_and_takes_no_work_of_its_own():
    budget = Budget(1000.0, work=10.0)
    share = budget.share(1 / 4)
    assert 249.0 < share.left <= 250.0
    share.spend(4.0)
    assert budget.work == 6.0
    own = budget.with_work(2.0)
    own.spend(1.0)
    own.grant(5.0)
    assert (own.work, budget.work) == (5.0, 6.0)


def test_a_budget_that_is_sent_elsewhere_ends_at_the_same_moment():
    budget, endless = Budget(1000.0), Budget()
    sent = pickle.dumps((budget, endless))
    time.sleep(0.01)
    one, other = pickle.loads(sent)
    assert one.left == pytest.approx(budget.left, abs=1.0)
    assert one.left < 1000.0
    assert not other.timed


def test_what_passes_is_counted_from_the_beginning_and_beyond_the_end(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    whole = Budget(8.0)
    half = whole.share(1 / 2)
    now[0] += 5.0
    assert (whole.elapsed, half.elapsed) == (5.0, 5.0)
    assert (whole.overrun, half.overrun) == (0.0, 1.0)
    assert whole.share(1 / 3).elapsed == 0.0
    assert Budget().overrun == 0.0
