"""Two implementations timed in turn."""

from itertools import count

import pytest

from suite.experiments.bench.compare import Comparison, Figure, in_turn


def test_bench_times_both_sides_in_turn():
    calls = []
    ticks = count()
    ours, baseline = in_turn(
        lambda: calls.append("ours"),
        lambda: (calls.append("baseline"), next(ticks), next(ticks)),
        repeats=3,
        clock=lambda: next(ticks),
    )
    assert calls == ["ours", "baseline"] * 4
    assert (ours, baseline) == (1, 3)
    figures = Figure(6.0, "steps/s"), Figure(2.0, "steps/s")
    assert Comparison("a", *figures).ratio == pytest.approx(3.0)
