"""Trials cut short, for tests of what is done around them."""

from dataclasses import replace

import eval.judging.judge
from eval.judging.judge import JudgeOptions
from eval.worlds.trial import Rules


def cut_short(monkeypatch, seconds):
    """Let the judge end every trial after so many seconds."""
    fly = eval.judging.judge.fly

    def short(policy, trials, vehicle, world="mujoco", options=None, *rest, **more):
        options = replace(options or JudgeOptions(), rules=Rules(time_limit_s=seconds))
        return fly(policy, trials, vehicle, world, options, *rest, **more)

    monkeypatch.setattr(eval.judging.judge, "fly", short)
