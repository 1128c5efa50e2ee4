"""Two implementations timed in turn."""

from itertools import count

import pytest

from suite.common.errors import WorkFailed
from suite.experiments.bench import diagnose, policy, sysid_baseline
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


def test_without_a_compiler_or_packages_it_says_what_to_install(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(WorkFailed, match="no C compiler"):
        policy.run()
    monkeypatch.setattr(sysid_baseline, "is_installed", lambda: False)
    with pytest.raises(WorkFailed, match=r"pip install 'mujoco\[sysid\]'"):
        diagnose.run()
