"""The options of `suite eval` and `suite collect` are what is recorded as asked for."""

from typing import Any

from suite.cli import parse
from suite.judging.requests import Collection, Evaluation


def asked(command: str, *args: str) -> Any:
    config = parse(command, args)[1]
    held = (config, *vars(config).values())
    return next(value for value in held if isinstance(value, Evaluation | Collection))


def test_options_of_eval_become_the_request():
    given = asked("eval", "--policy", "racer", "--policy", "a.onnx", "--trials", "2")
    assert (given.policies, given.trials) == (("racer", "a.onnx"), 2)


def test_flights_are_recorded_far_from_the_seeds_that_are_judged():
    assert asked("collect").seed - asked("eval").seed >= 100_000
