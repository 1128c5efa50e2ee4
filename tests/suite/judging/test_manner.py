"""What is asked for: in what manner policies fly, and the options that become a request."""

from dataclasses import replace
from typing import Any

import pytest

from policies.policy import load_policy
from policies.spec import PolicyError
from suite import cli
from suite.cli import parse
from suite.judging.requests import Collection, Evaluation, Manner, manners


@pytest.fixture(scope="module")
def policy():
    return load_policy("racer")


def test_every_speed_is_flown_and_again_with_the_monitor():
    assert manners((), False) == [Manner()]
    assert manners((0.0, 1.0), True) == [
        Manner(speed=0.0), Manner(speed=1.0), Manner(True, 0.0), Manner(True, 1.0)
    ]  # fmt: skip
    assert Manner(True, 0.25).label("mine") == "mine@0.25+monitor"
    assert Manner().label("mine") == "mine"


def test_a_speed_goes_into_the_spec_that_is_observed_by(policy):
    quick = replace(policy, spec=replace(policy.spec, speed_input=True))
    assert Manner(speed=0.0)(quick).spec.speed == 0.0
    assert Manner()(quick) is quick


def test_a_policy_without_that_input_is_one_line(policy, tmp_path, capsys):
    with pytest.raises(PolicyError, match="racer takes no speed"):
        Manner(speed=0.5)(policy)
    assert cli.main(["eval", "--policy", "racer", "--speed", "0.5", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "spec.speed_input=True" in said and len(said.strip().splitlines()) == 1


def asked(command: str, *args: str) -> Any:
    config = parse(command, args)[1]
    held = (config, *vars(config).values())
    return next(value for value in held if isinstance(value, Evaluation | Collection))


def test_options_become_the_request_and_recorded_seeds_are_far_from_judged_ones():
    given = asked("eval", "--policy", "racer", "--policy", "a.onnx", "--trials", "2")
    assert (given.policies, given.trials) == (("racer", "a.onnx"), 2)
    assert asked("collect").seed - asked("eval").seed >= 100_000
