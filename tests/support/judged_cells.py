"""Trials and cells of a table, with the numbers that documents look at; trials cut short."""

from dataclasses import replace

import eval.judging.judge
from eval.judging.judge import JudgeOptions
from eval.judging.statistics import Interval
from eval.judging.tables import Tally
from eval.worlds.trial import Rules, TrialResult


def cell(track, level, success, v_max=5.0, low=None):
    speed = Interval(v_max, v_max, v_max)
    rate = Interval(success, success if low is None else low, 1.0)
    return Tally("p", track, level, 100, rate, 8.0, speed, speed, speed, {})


def result(seed, success=True, policy="ours", difficulty=3, speed=5.0):
    return TrialResult(
        "zigzag", difficulty, seed, policy, "reference", "mujoco", success, 8 if success else 3,
        "finished" if success else "collision", None if success else "pillar 2",
        1.0, 2.0, 3.0, 9.5 + seed, speed + seed, speed - 1, 7, 8, 0, 0, 0,
    )  # fmt: skip


def results_of(won, trials=40):
    """Return the results of each policy, which succeeds in so many of the trials of two cells."""
    return {
        name: [result(k, k < count, "p", k % 2) for k in range(trials)]
        for name, count in won.items()
    }


ROWS = [result(0), result(1, False), result(2), result(3)]


def cut_short(monkeypatch, seconds=None, stop_after=None):
    """Let the judge end trials after so many seconds, and interrupt it after so many of them.

    Returns the list of the trials that it has flown.
    """
    fly, flown = eval.judging.judge.fly, []

    def short(policy, trials, vehicle, world="mujoco", options=None, on_result=None, *rest, **more):
        def keep(result, flight):
            if on_result is not None:
                on_result(result, flight)
            flown.append(result.trial)
            if len(flown) == stop_after:
                raise KeyboardInterrupt

        if seconds is not None:
            options = replace(options or JudgeOptions(), rules=Rules(time_limit_s=seconds))
        return fly(policy, trials, vehicle, world, options, keep, *rest, **more)

    monkeypatch.setattr(eval.judging.judge, "fly", short)
    return flown
