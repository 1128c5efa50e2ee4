"""Documents at a small size: flights are a tenth of a second long, a few at a time."""

import json
from dataclasses import replace
from itertools import product

import pytest

from eval.worlds import rotorpy as rotorpy_world
from eval.worlds.trial import Rules
from suite.experiments.simulators import REASONS, Config, changed_trials, conditions
from suite.experiments.study import disturbed, judging
from tests.support import judged_cells
from tests.support.documents import another_racer, page, reproduce
from tests.support.engines import STAND_IN


class Sky:
    """Counts the trials that are flown, and stops at a given one."""

    def __init__(self, monkeypatch):
        self.flown = []
        self.stop_after = None
        self._fly = judging.fly_share
        monkeypatch.setattr(judging, "fly_share", self.fly)
        monkeypatch.setattr(judging, "usable_cores", lambda: 1)

    def fly(self, task, share):
        options = replace(task.options, slots=8, rules=Rules(time_limit_s=0.1))
        for index, result, flight in self._fly(replace(task, options=options), share):
            self.flown.append((task.policy.name, task.vehicle, options.sensors, result.trial))
            yield index, result, flight
            if self.stop_after == len(self.flown):
                self.stop_after = None
                raise KeyboardInterrupt


@pytest.fixture
def sky(monkeypatch):
    return Sky(monkeypatch)


def test_robustness(sky, tmp_path):
    args = "--trials 1 --difficulty 0 --policy race-paper --only wind mass_offset".split()
    sky.stop_after = 5
    assert reproduce(tmp_path, "robustness", *args, "gate-pose error") == 130
    assert reproduce(tmp_path, "robustness", *args, "gate-pose error") == 0
    # Undisturbed once for all, two signs of mass, four winds, four gate errors; three tracks.
    assert len(sky.flown) == 3 * (1 + 2 + 4 + 4)
    winds = {flight[1].effects["constant_wind"].velocity for flight in sky.flown
             if "constant_wind" in flight[1].effects}  # fmt: skip
    assert sorted(round(y / 0.8) for _, y, _ in winds) == [2, 4, 6, 8]
    maps = [flight[2].models.get("gate_map") for flight in sky.flown]
    assert {values and values.moved for values in maps} == {None, 0.05, 0.1, 0.2, 0.3}
    text, numbers = page(tmp_path, "robustness")
    assert len(numbers["conditions"]) == 1 + 2 + 5 + 5
    assert text.count("| 0 % [0, 56] |") == 13
    assert (tmp_path / "docs" / "robustness-2.png").is_file()


def test_perception(sky, tmp_path):
    args = "--only vio stereo --difficulty 0,3 --trials 1 --growing-trials 1 --policy race-paper"
    trained = tmp_path / "trained"
    another_racer(trained, 3)
    assert reproduce(tmp_path, "perception", *args.split(), "--policy", str(trained)) == 0
    # Two policies: perfect and a preset on two levels, and the preset at three more magnitudes on
    # one of them. The first policy: one model at two magnitudes.
    assert len(sky.flown) == 2 * 3 * (2 * 2 + 3) + 3 * 2, "magnitude 1 of a preset is that preset"
    noises = {flight[2].models["stereo"].noise for flight in sky.flown
              if list(flight[2].models) == ["stereo"]}  # fmt: skip
    assert sorted(noises) == pytest.approx([0.1, 0.2])
    text, numbers = page(tmp_path, "perception")
    assert len(numbers["conditions"]) == 2 + 5 + 3
    assert text.count("| 0 % [0, 56] | 0 % [0, 56] | 0 % [0, 39] |") == 4
    assert "| sensors | trained |\n" in text and text.count("| +0 [-39, +39], +0.0% |") == 2
    assert text.count("| stereo | race-paper | 0 % [0, 56], ") == 1
    assert "| stereo | trained |" not in text and "| vio | trained |" in text
    assert (tmp_path / "docs" / "perception-2.png").is_file()


def test_table2_and_all_levels(sky, tmp_path, capfd):
    sky.stop_after, sizes = 11, ("--trials", "1", "--seed", "7")
    assert reproduce(tmp_path, "table2", *sizes) == 130
    assert not (tmp_path / "docs").exists() and len(sky.flown) == 11
    assert reproduce(tmp_path, "table2", *sizes) == 0
    assert "11 of 30 trials were flown before" in capfd.readouterr().err
    assert len(sky.flown) == len(set(trial for *_, trial in sky.flown)) == 30
    text, numbers = page(tmp_path, "table2")
    cells = {(cell["track"], cell["difficulty"]) for cell in numbers["cells"]}
    assert cells == set(product(("zigzag", "circular", "ellipse"), range(10)))
    # In a second nobody finishes: every cell misses what is asked of it, and says by how much.
    assert all(goal["success_miss"] > 0 for goal in numbers["goals"]["ours"])
    assert "| 90.0 points | 97 % | 97.0 points |" in text
    assert "| paper, with Delta Action Model | 9 | 7/10 | 6.1 |" in text
    assert "seeds: 7 to 7, 1 trials per cell" in text
    # Other documents find the flights of this one.
    assert reproduce(tmp_path, "robustness", *sizes, "--difficulty", "0", "--only", "wind") == 0
    assert len(sky.flown) == 30 + 3 * 4, "the undisturbed is there"
    capfd.readouterr()
    assert reproduce(tmp_path, "table2", *sizes, "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert said["out"].endswith("table2.md") and len(said["cells"]) == 30
    assert len(sky.flown) == 30 + 3 * 4, "a second time nothing is flown"


@pytest.fixture
def rotorpy(monkeypatch):
    monkeypatch.setattr(rotorpy_world, "rotorpy", lambda: STAND_IN)


def test_a_policy_in_two_worlds_and_a_control(sky, rotorpy, tmp_path):
    args = "--policy race-paper --simulator rotorpy --trials 1 --difficulty 0".split()
    sky.stop_after = 4
    assert reproduce(tmp_path, "simulators", *args) == 130
    assert reproduce(tmp_path, "simulators", *args) == 0
    assert len(sky.flown) == 3 * 3
    drags = ["linear_drag" in vehicle.effects for _, vehicle, _, _ in sky.flown]
    assert drags == [True] * 3 + [False] * 3 + [True] * 3
    text, numbers = page(tmp_path, "simulators")
    labels = [entry["column"] for entry in numbers["success"]]
    assert labels == ["mujoco", "mujoco, the air of rotorpy", "rotorpy"]
    assert "| rotorpy | linear_drag: RotorPy's drag is proportional to the rotors' speed" in text
    assert "same ending" in text and numbers["changed"] == []


def test_why_is_told_by_the_controls(rotorpy):
    flown_in = conditions(Config(simulator=("mjx", "rotorpy")))
    base, single, aired, other = (condition.name for condition in flown_in)
    assert flown_in[2].simulator == "mujoco" and flown_in[2].vehicle != flown_in[0].vehicle
    won = {base: "1111", single: "0111", aired: "1011", other: "0001"}
    tested = [
        disturbed.ConditionResult(
            one,
            {"p": [judged_cells.result(k, digit == "1") for k, digit in enumerate(won[one.name])]},
        )
        for one in flown_in
    ]
    found = changed_trials(tested)
    mine = {change["trial"].seed: change["why"] for change in found if change["column"] == other}
    assert mine == {0: "rounding", 1: "air", 2: "rest"}
    alone = changed_trials([tested[0], *tested[2:]])  # without mjx
    unknown = {c["trial"].seed: c["why"] for c in alone if c["column"] == other}
    assert unknown == {0: "rest or rounding", 1: "air", 2: "rest or rounding"}
    assert {*mine.values(), *unknown.values()} == set(REASONS)
    assert [change["why"] for change in found if change["column"] in (single, aired)] == [None] * 2
    assert found[0]["endings"][base] == tested[0].results["p"][0].ending
