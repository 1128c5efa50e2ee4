"""Policies in several worlds at a small size, and why trials change."""

import pytest

from eval.worlds import rotorpy as rotorpy_world
from suite.experiments.worlds import WHY, Column, Config, changes, columns
from tests.support.documents import page, reproduce
from tests.support.engines import STAND_IN
from tests.support.loops import trial_result


@pytest.fixture
def rotorpy(monkeypatch):
    monkeypatch.setattr(rotorpy_world, "rotorpy", lambda: STAND_IN)


def test_a_policy_in_two_worlds_and_a_control(sky, rotorpy, tmp_path):
    args = ["--policy", "racer", "--world", "rotorpy", "--trials", "1", "--difficulty", "0"]
    sky.stop_after = 4
    assert reproduce(tmp_path, "worlds", *args) == 130
    assert reproduce(tmp_path, "worlds", *args) == 0
    assert len(sky.flown) == 3 * 3
    drags = ["linear_drag" in vehicle.effects for _, vehicle, _, _ in sky.flown]
    assert drags == [True] * 3 + [False] * 3 + [True] * 3
    text, numbers = page(tmp_path, "worlds")
    labels = [entry["column"] for entry in numbers["success"]]
    assert labels == ["mujoco", "mujoco, the air of rotorpy", "rotorpy"]
    assert "| rotorpy | linear_drag: RotorPy's drag goes with the rotors' speed" in text
    assert "ends alike" in text and numbers["changed"] == []


def test_why_is_told_by_the_controls(rotorpy):
    flown_in = columns(Config(world=("mjx", "rotorpy")))
    base, single, aired, other = (column.label for column in flown_in)
    assert flown_in[2] == Column(aired, "mujoco", flown_in[2].vehicle, "rotorpy")
    won = {base: "1111", single: "0111", aired: "1011", other: "0001"}
    results = {
        ("p", label): [trial_result(k, digit == "1") for k, digit in enumerate(digits)]
        for label, digits in won.items()
    }
    found = changes(["p"], flown_in, results)
    mine = {change["trial"].seed: change["why"] for change in found if change["column"] == other}
    assert mine == {0: "rounding", 1: "air", 2: "rest"} and set(mine.values()) == set(WHY)
    assert [change["why"] for change in found if change["column"] in (single, aired)] == [None] * 2
    assert found[0]["endings"][base] == results["p", base][0].ending
