"""Documents and trainings at a size of seconds, and their numbers by hand."""

import json
from dataclasses import replace
from itertools import product

import pytest

from eval.judging.statistics import wilson
from eval.worlds import rotorpy as rotorpy_world
from eval.worlds.trial import Rules
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.experiments.ablation import Config as Ablation
from suite.experiments.ablation import _comparison_grid, settings
from suite.experiments.pages.paper import ablation as printed
from suite.experiments.schemes import Config as SchemesConfig
from suite.experiments.schemes import document, first_times, schemes
from suite.experiments.simulators import REASONS, Config, changed_trials, conditions
from suite.experiments.study import judging, validation
from suite.experiments.study.cache import Workspace
from suite.experiments.study.conditions import ConditionResult
from suite.experiments.study.training import Spread, TrainingResult, summaries
from suite.train import run as training_run
from suite.train.config import TrainConfig
from suite.train.ppo.config import PpoConfig
from tests.support import judged_cells
from tests.support.documents import another_racer, page, reproduce, unpainted
from tests.support.engines import STAND_IN
from tests.support.training import boxes_worlds
from tracks.common.grid import Grid


class Sky:
    """Counts the trials that are flown, and stops at a given one."""

    def __init__(self, monkeypatch):
        unpainted(monkeypatch)
        self.flown = []
        self.stop_after = None
        self._fly = judging.fly_share
        monkeypatch.setattr(judging, "fly_share", self.fly)
        monkeypatch.setattr("suite.judging.flying.usable_cores", lambda: 1)

    def fly(self, task, share):
        options = replace(task.options, slots=8, rules=Rules(time_limit_s=0.04))
        for index, result, *others in self._fly(replace(task, options=options), share):
            self.flown.append((task.policy.name, task.vehicle, options.sensors, result.trial))
            yield index, result, *others
            if self.stop_after == len(self.flown):
                self.stop_after = None
                raise KeyboardInterrupt


@pytest.fixture
def sky(monkeypatch):
    return Sky(monkeypatch)


@pytest.mark.extended
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


@pytest.mark.extended
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
    other = ("--difficulty", "0", "--only", "mass_offset")
    assert reproduce(tmp_path, "robustness", *sizes, *other) == 0
    assert len(sky.flown) == 30 + 3 * 2, "the undisturbed is there"
    capfd.readouterr()
    assert reproduce(tmp_path, "table2", *sizes, "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert said["out"].endswith("table2.md") and len(said["cells"]) == 30
    assert len(sky.flown) == 30 + 3 * 2, "a second time nothing is flown"


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
        ConditionResult(
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


TINY = "--set spec.hidden_size=8 spec.camera.width=20 spec.camera.height=20 episode.steps=6"
TINY += " --iterations 2 --worlds 4 --trials 3 --seconds 0.5 --training-seeds 4 --only"


@pytest.fixture
def small_scenes(monkeypatch):
    for module in ("train.run", "train.ppo.update", "experiments.study.validation"):
        monkeypatch.setattr(f"suite.{module}.sample_worlds", boxes_worlds)


def test_settings_differ_in_field_and_progress_alone():
    rows = {row.key: row for row in settings(Ablation())}
    added = {"field 0.8", "field 1.2", "field 1.6", "field 3.2", "progress 1.2"}
    assert set(rows) - set(printed()[1]) == added
    losses = {key: row.recipe.loss for key, row in rows.items()}
    for key, loss in losses.items():
        kind, weight = key.split()
        assert (loss.field_gain > 0) == (kind == "field")
        progress = {"progress": loss.progress, "progress_norm": loss.progress_norm}
        own = progress.pop("progress_norm" if kind == "normalised" else "progress")
        assert own == float(weight) and list(progress.values()) == [0]
        assert rows[key].recipe.episode.gates == 4 and loss.projection == 0
    others = {str(row.recipe).replace(str(row.recipe.loss), "") for row in settings(Ablation())}
    assert len(others) == 1
    nearly = settings(Ablation(set=("loss.progress=0.4000001",)))
    assert [row.key for row in nearly].count("field 0.4") == 1
    assert len(settings(Ablation(recipe="paper"))) == 11, "its own weight is one of the paper's"


def test_schemes_share_all_but_how_they_learn():
    ppo, ours, bare = (scheme.recipe for scheme in schemes(SchemesConfig()))
    assert isinstance(ppo, PpoConfig) and isinstance(ours, TrainConfig)
    assert ppo.iterations == ours.optimizer.iterations
    for name in ("spec", "physics", "quadrotor", "episode", "seed"):
        assert getattr(ppo, name) == getattr(ours, name) == getattr(bare, name)
    assert ours == settings(Ablation(only=("field 0.4",)))[0].recipe
    assert bare.loss.field_gain == 0 and bare.loss.progress == 0.4
    assert (bare.loss.projection, bare.loss.projection_decay) == (3.0, 0.5)
    (longer,) = schemes(SchemesConfig(ppo_iterations=7, only=("ppo",)))
    assert isinstance(longer.recipe, PpoConfig) and longer.recipe.iterations == 7


@pytest.mark.slow
def test_the_ablation_from_one_command_and_again(tmp_path, monkeypatch, small_scenes):
    args = [*TINY.split(), "field 0.4", "normalised 6.4"]
    train, made = training_run.train, []

    def diverging(config, folder, console, watch=None):
        made.append((config.loss.progress_norm, config.seed))
        if config.loss.progress_norm:
            raise WorkFailed("training diverged at iteration 1")
        return train(config, folder, console)

    monkeypatch.setattr(training_run, "train", diverging)
    assert reproduce(tmp_path, "ablation", *args) == 0
    assert made == [(0, 4), (6.4, 4)]
    text, numbers = page(tmp_path, "ablation")
    field, normalised = numbers["rows"]
    assert (field["seeds"], field["diverged"]) == (1, 0)
    assert (normalised["seeds"], normalised["diverged"]) == (1, 1)
    # In half a second nobody passes four gates; who has not moved far hits nothing.
    assert field["over"]["success_cross"]["most"] == 0
    assert field["over"]["collision_free"]["least"] == 1 and field["over"]["v_max"]["mean"] > 0
    assert "| without, L_p^norm | 6.4 | diverged | 58 |" in text and "| 1 of 1 |" in text
    monkeypatch.setattr(training_run, "make_update", pytest.fail)
    assert reproduce(tmp_path, "ablation", *args) == 0, "nothing is trained again"
    assert (tmp_path / "docs" / "ablation.md").read_text() == text


@pytest.fixture
def measured(monkeypatch):
    """Measure no flight: return the recipes that would be flown."""
    recipes = []
    scores = {"success_cross": 0.5, "collision_free": 1.0, "v_max": 6.44, "v_max_most": 7.0}

    def make_validation(recipe, trials, seed, seconds):
        recipes.append((recipe, trials, seed, seconds))
        return lambda params: {**scores, "gates": 3.25, "reward": 0.0}

    monkeypatch.setattr(validation, "make_validation", make_validation)
    return recipes


@pytest.mark.extended
def test_shipped_policies_fly_the_ablations_tracks_in_the_dynamics_of_their_training(
    tmp_path, measured, capsys
):
    args = "--policy race --policy race-paper --trials 10 --seconds 4 --seed 7".split()
    assert reproduce(tmp_path, "four_gates", *args) == 0
    (race, *rest), (point_mass, *_) = measured
    assert rest == [10, 7, 4.0] and race.spec.rate_hz == 30 and race.quadrotor.vehicle
    assert point_mass.quadrotor is None
    tracks = settings(Ablation(set=(), worlds=48))[0].recipe.episode
    assert race.episode == point_mass.episode == tracks and tracks.gates == 4
    text, numbers = page(tmp_path, "four_gates")
    assert "| race | 50 % [24, 76] | 100 % [72, 100] | 6.4 | 7.0 | 3.25 |" in text
    assert "| paper, with the field | 95 % | 97 % | 6.5 | - | - |" in text
    assert [row["policy"] for row in numbers["rows"]] == ["race", "race-paper"]
    assert numbers["rows"][0]["intervals"]["success_cross"] == wilson(5, 10)._asdict()
    assert reproduce(tmp_path, "four_gates", "--policy", "race-papr") == 2
    assert "Did you mean 'race-paper'?" in capsys.readouterr().err
    assert reproduce(tmp_path, "four_gates", "--seed", "0") == 2
    assert "measured on worlds of its training" in capsys.readouterr().err


@pytest.mark.slow
def test_a_shipped_policy_passes_four_gates(tmp_path):
    args = "--policy race-paper --trials 8 --seconds 8".split()
    assert reproduce(tmp_path, "four_gates", *args) == 0
    _, numbers = page(tmp_path, "four_gates")
    assert numbers["rows"][0]["gates"] > 3.5 and numbers["rows"][0]["v_max"] > 4.0


@pytest.mark.slow
def test_the_comparison_of_schemes_from_one_command(tmp_path, small_scenes):
    assert reproduce(tmp_path, "schemes", *TINY.split(), "ours", "ppo") == 0
    text, numbers = page(tmp_path, "schemes")
    assert [row["scheme"] for row in numbers["rows"]] == ["ppo", "ours"]
    for row in numbers["rows"]:
        assert row["steps"] == [0, 4 * 6, 2 * 4 * 6] and row["time"][0] == 0 < row["time"][1]
        assert row["curves"]["collision_free"][0]["mean"] == 1.0
        assert row["compile_s"] > 0 and row["reached"]["1"] == []
    # Before the first step both are the same network in the same worlds.
    one, two = (row["curves"]["reward"][0] for row in numbers["rows"])
    assert one["mean"] == pytest.approx(two["mean"]) and one["mean"] != 0
    assert "not reached" in text


def trained(key, seed, *points, diverged=""):
    return TrainingResult(key, seed, 60.0, 5.0, "c", "m", diverged, list(points))


def judged(key, *cross, rate=1.0, v_max=5.0):
    """Return runs with these shares of successes; a run without one has diverged."""
    for seed, value in enumerate(cross):
        numbers = {"success_cross": value, "collision_free": rate, "v_max": v_max + seed,
                   "v_max_most": v_max + 2, "gates": 4.0}  # fmt: skip
        if value is None:
            yield trained(key, seed, diverged="it diverged")
        else:
            yield trained(key, seed, numbers)


def test_spread_by_hand():
    chosen = settings(Ablation(only=("field 0.4", "progress 3.2", "normalised 6.4")))
    runs = [
        *judged("field 0.4", 0.9, 1.0, 0.8),
        *judged("progress 3.2", 0.3, 0.1, None, rate=0.3),
        *judged("normalised 6.4", None),
    ]
    field, bare, gone = summaries(chosen, runs)
    assert field.at[-1]["success_cross"] == pytest.approx(Spread(0.9, 0.8, 1.0))
    assert field.at[-1]["v_max"] == Spread(6.0, 5.0, 7.0)
    assert (bare.seeds, bare.diverged) == (3, 1)
    assert not gone.at and gone.diverged == 1
    line = [cell.text for cell in _comparison_grid([field]).rows[0]]
    assert line[2:4] == ["90 [80, 100]", "95"]
    assert line[6:9] == ["6.0 [5.0, 7.0]", "7.0", "6.5"]


def learnt(scheme, seed, pace, *gates, diverged=""):
    """Return a run measured at 0, 100 and 200 steps."""
    points = (
        {"steps": 100.0 * k, "time": pace * k, "gates": g, "reward": 10 * g, "v_max": 4.0,
         "collision_free": 1.0, "success_cross": g / 4}
        for k, g in enumerate(gates)
    )  # fmt: skip
    return trained(scheme, seed, *points, diverged=diverged)


def test_a_page_of_schemes_that_all_diverged_has_no_chart(tmp_path, monkeypatch):
    runs = [learnt("ours", seed, 1.0, diverged="it diverged") for seed in (0, 1, 2)]
    monkeypatch.setattr("suite.experiments.study.training.train_all", lambda *_, **__: runs)
    contents = document(SchemesConfig(only=("ours",)), Workspace(tmp_path, tmp_path), Console())
    chartless, *_ = contents.parts["Learning curves"]
    assert isinstance(chartless, Grid) and contents.numbers["rows"][0]["diverged"] == 3


def test_curves_and_first_times_by_hand():
    runs = [
        learnt("ppo", 0, 4.0, 0.0, 0.5, 1.5),
        learnt("ppo", 1, 4.0, 0.0, 0.5, 0.5),
        learnt("ours", 0, 1.0, 0.0, 1.0, 3.0),
        learnt("ours", 1, 3.0, 0.0, 2.0, 4.0),
        learnt("ours", 2, 3.0, 0.0, diverged="it diverged"),
    ]
    ppo, ours = summaries(schemes(SchemesConfig(only=("ours", "ppo"))), runs)
    assert [p["steps"].mean for p in ours.at] == [0, 100, 200] and ours.diverged == 1
    assert [p["time"].mean for p in ours.at] == [0, 2, 4]
    assert [p["gates"] for p in ours.at[1:]] == [Spread(1.5, 1.0, 2.0), Spread(3.5, 3.0, 4.0)]
    assert first_times(ours, 2) == [(200, 2.0), (100, 3.0)]
    assert first_times(ours, 3) == [(200, 2), (200, 6)]
    assert first_times(ppo, 1) == [(200, 8.0)] and first_times(ppo, 2) == []
