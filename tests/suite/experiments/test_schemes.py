"""The comparison of training schemes at a size of seconds, and its numbers by hand."""

import pytest

from suite.experiments.ablation import Config as AblationConfig
from suite.experiments.ablation import settings
from suite.experiments.schemes import Config, first_times, schemes
from suite.experiments.study.summary import Spread, summaries
from suite.experiments.study.training import TrainingResult
from suite.train.config import TrainConfig
from suite.train.ppo.config import PpoConfig
from tests.suite.experiments.test_ablation import SMALL
from tests.support.documents import page, reproduce
from tests.support.training import boxes_worlds

TINY = ["--set", *SMALL, "--iterations", "2", "--worlds", "4", "--trials", "3", "--seconds", "0.5"]


def test_schemes_share_all_but_how_they_learn():
    ppo, ours, bare = (scheme.recipe for scheme in schemes(Config()))
    assert isinstance(ppo, PpoConfig) and isinstance(ours, TrainConfig)
    assert ppo.iterations == ours.optimizer.iterations
    for name in ("spec", "physics", "quadrotor", "episode", "seed"):
        assert getattr(ppo, name) == getattr(ours, name) == getattr(bare, name)
    assert ours == settings(AblationConfig(only=("field 0.4",)))[0].recipe
    assert ours.loss.field_gain > 0 and ours.loss.projection == 0
    assert bare.loss.field_gain == 0 and bare.loss.progress == 0.4
    assert (bare.loss.projection, bare.loss.projection_decay) == (3.0, 0.5)
    (longer,) = schemes(Config(ppo_iterations=7, only=("ppo",)))
    assert isinstance(longer.recipe, PpoConfig) and longer.recipe.iterations == 7


@pytest.mark.slow
def test_the_comparison_from_one_command_and_again(tmp_path, monkeypatch):
    for module in (
        "suite.train.run",
        "suite.train.ppo.update",
        "suite.experiments.study.validation",
    ):
        monkeypatch.setattr(f"{module}.sample_worlds", boxes_worlds)
    args = [*TINY, "--only", "ours", "ppo", "--training-seeds", "4"]
    assert reproduce(tmp_path, "schemes", *args) == 0
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
    for module in ("suite.train.run", "suite.train.ppo.update"):
        monkeypatch.setattr(f"{module}.make_update", None)
    assert reproduce(tmp_path, "schemes", *args) == 0, "nothing is trained again"
    assert (tmp_path / "docs" / "schemes.md").read_text() == text


def learnt(scheme, seed, pace, gates, diverged=""):
    """Return a run measured at 0, 100 and 200 steps."""
    points = [
        {"steps": 100.0 * k, "time": pace * k, "gates": g, "reward": 10 * g, "v_max": 4.0,
         "collision_free": 1.0, "success_cross": g / 4}
        for k, g in enumerate(gates)
    ]  # fmt: skip
    return TrainingResult(scheme, seed, "", 60.0, 5.0, "c", diverged, points)


def test_curves_and_first_times_by_hand():
    chosen = schemes(Config(only=("ours", "ppo")))
    runs = [
        learnt("ppo", 0, 4.0, [0.0, 0.5, 1.5]),
        learnt("ppo", 1, 4.0, [0.0, 0.5, 0.5]),
        learnt("ours", 0, 1.0, [0.0, 1.0, 3.0]),
        learnt("ours", 1, 3.0, [0.0, 2.0, 4.0]),
        learnt("ours", 2, 3.0, [0.0], "it diverged"),
    ]
    ppo, ours = summaries(chosen, runs)
    assert [p["steps"].mean for p in ours.at] == [0, 100, 200] and ours.diverged == 1
    assert [p["time"].mean for p in ours.at] == [0, 2, 4]
    assert [p["gates"] for p in ours.at[1:]] == [Spread(1.5, 1.0, 2.0), Spread(3.5, 3.0, 4.0)]
    assert first_times(ours, 2) == [(200, 2.0), (100, 3.0)]
    assert first_times(ours, 3) == [(200, 2), (200, 6)]
    assert first_times(ppo, 1) == [(200, 8.0)] and first_times(ppo, 2) == []
