"""The options of `suite eval` and `suite collect` are what is recorded as asked for."""

from suite.cli import parse
from suite.judging.requests import Collection, Evaluation


def asked(command, *args):
    config = parse(command, args)[1]
    found = [value for value in vars(config).values() if isinstance(value, Evaluation | Collection)]
    return config if isinstance(config, Evaluation | Collection) else found[0]


def test_options_of_eval_become_the_request():
    given = asked(
        "eval", "--policy", "racer", "--policy", "a.onnx", "--procs", "2", "--trials", "7"
    )
    assert (given.policies, given.processes, given.trials) == (("racer", "a.onnx"), 2, 7)


def test_flights_are_recorded_far_from_the_seeds_that_are_judged():
    given = asked("collect")
    assert given.seed - asked("eval").seed >= 100_000
