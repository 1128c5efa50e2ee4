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


ROWS = [result(0), result(1, False), result(2), result(3)]


def cut_short(monkeypatch, seconds):
    """Let the judge end every trial after so many seconds."""
    fly = eval.judging.judge.fly

    def short(policy, trials, vehicle, world="mujoco", options=None, *rest, **more):
        options = replace(options or JudgeOptions(), rules=Rules(time_limit_s=seconds))
        return fly(policy, trials, vehicle, world, options, *rest, **more)

    monkeypatch.setattr(eval.judging.judge, "fly", short)
