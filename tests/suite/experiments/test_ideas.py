"""One change of a recipe at a time: the rows, their numbers by hand, and the whole command."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.apart import Job
from suite.experiments.ideas import Config, compared, ideas, is_round, lead, refused_rows
from suite.experiments.study.training import Looks, train_one
from suite.train import run as training_run
from suite.train.overrides import override
from suite.train.worlds import sample_worlds
from tests.suite.experiments.test_ablation import SMALL
from tests.support.documents import page, reproduce


def test_every_row_is_the_recipe_with_its_changes():
    rows = ideas(Config())
    base = rows[0].recipe
    assert base.episode.image_stride == 3 and not rows[0].changes
    for row in rows[1:]:
        assert row.changes and row.recipe == override(base, row.changes) != base
    by_key = {row.key: row.recipe for row in rows}
    assert len(by_key) == len(rows)
    longer, truncated = by_key["longer"], by_key["longer, truncated"]
    assert longer.episode.steps * longer.episode.batch == base.episode.steps * base.episode.batch
    assert truncated.episode == longer.episode
    assert truncated.loss.gradient_decay == pytest.approx(2 * base.loss.gradient_decay)
    assert by_key["L_proj"].loss.field_gain == 0 < by_key["field and L_proj"].loss.field_gain
    assert by_key["round"].episode == by_key["round, square field"].episode
    assert [row.key for row in rows if is_round(row)] == ["round", "round, square field"]
    assert [row.key for row in ideas(Config(only=("longer",)))] == ["recipe", "longer"]


@pytest.mark.parametrize("preset", ["small", "direct", "paper"])
def test_deciding_twice_as_often_keeps_the_seconds(preset: str):
    asked = Config(preset=preset, set=(), only=("often", "finer image", "wider memory"))
    base, often, finer, wider = (row.recipe for row in ideas(asked))
    assert often.spec.rate_hz == 2 * base.spec.rate_hz
    for name in ("steps", "image_stride"):
        assert getattr(often.episode, name) == 2 * getattr(base.episode, name)
    for name in ("state_delay", "image_delay"):
        assert getattr(often.physics, name) == 2 * getattr(base.physics, name)
    # The point mass holds two decisions of delay at most; quadrotors have theirs in seconds.
    longest = base.physics.action_delay[1]
    wanted = longest if base.quadrotor else min(2.0, 2 * longest)
    assert often.physics.action_delay[1] == wanted
    assert (finer.spec.camera.width, finer.spec.camera.height) == (48, 36)
    assert finer.episode == wider.episode == base.episode
    assert wider.spec.hidden_size == 320


def test_a_change_that_the_recipe_has_already_is_no_row():
    keys = {row.key for row in ideas(Config(preset="swift"))}
    assert not keys & {"second gate", "gate axis", "pass first", "finish", "heights"}
    assert {"recipe", "curriculum", "L_proj", "round"} < keys


def test_a_recipe_with_round_gates_is_refused():
    with pytest.raises(ValueError, match=r"gate_corners=8: the judge's gates have 4"):
        ideas(Config(set=("episode.gate_corners=8",)))


def flown(*won) -> list[Any]:
    """Return trials with what a row looks at."""
    ends = {1: "finished", 0: "collision"}
    return [SimpleNamespace(success=w == 1, v_max=4.0 + w, ended_by=ends[w]) for w in won]


def test_differences_and_verdicts_by_hand():
    base = np.array([[1, 0, 0, 0] * 5, [0, 0, 0, 0] * 5, [0, 0, 0, 0] * 5], bool)
    quarter, none = [1, 0, 0, 0] * 5, [0] * 20
    better = compared("a", [flown(*[1, 1, 0, 0] * 5), flown(*quarter), flown(*quarter)], base, 9.0)
    assert better.success == [0.5, 0.25, 0.25] and better.of_seeds == [0.25, 0.25, 0.25]
    assert better.difference.value == 0.25 and better.difference.low > 0
    assert better.gap.verdict == "gain" and better.v_max == 4.0 and better.seconds == 9.0
    # More over all trials, but not with every seed.
    torn = compared("b", [flown(*[1] * 20), flown(*none), flown(*none)], base, 9.0)
    assert torn.difference.value == 0.25 and torn.of_seeds == [0.75, 0.0, 0.0]
    assert torn.gap.verdict == "unclear"
    worse = compared("c", [flown(*none)] * 3, np.ones((3, 20), bool), 9.0)
    assert worse.gap.verdict == "loss" and worse.of_seeds == [-1, -1, -1]
    assert worse._replace(of_seeds=[-1, -1]).gap.verdict == "unclear", "two seeds tell nothing"
    same = compared("recipe", [flown(*row) for row in base], base, 9.0)
    said = lead([same, better, torn, worse])
    assert said.startswith("Of the recipe's trials 8 % succeed. More succeed with a (+25 [")
    assert "Fewer succeed with c (-100 [-100, -100])." in said and "do not tell for b." in said


@pytest.mark.slow
def test_the_rows_are_trained_and_judged_once(sky, made, tmp_path, monkeypatch):
    numbers = {"success_cross": 0.5, "success_rate": 1.0, "v_max": 3.0, "gates": 6.0}
    seen = []

    def validation(recipe, *worlds):
        return lambda params: seen.append((recipe, worlds)) or numbers

    monkeypatch.setattr("suite.experiments.study.validation.make_validation", validation)

    def read(folder, name=""):
        return [] if name else [{"seconds": 7, "cold": False}]

    monkeypatch.setattr("suite.common.curve.read", read)
    args = ["ideas", "--trials", "1", "--difficulty", "0", "--training-seeds", "3", "5"]
    assert reproduce(tmp_path, *args) == 0
    rows = ideas(Config())
    judged = [row for row in rows if not is_round(row)]
    assert len(made) == len(rows) * 2 and {c.seed for c in made} == {3, 5}
    assert len(sky.flown) == len(judged) * 2 * 3
    assert [recipe.loss.field_square for recipe, _ in seen] == [False, False, True, True]
    assert {recipe.episode.gate_corners for recipe, _ in seen} == {8}
    assert {worlds for _, worlds in seen} == {(300, 1000, 20.0)}
    text, found = page(tmp_path, "ideas")
    assert [row["key"] for row in found["rows"]] == [row.key for row in judged]
    assert "| round | round gates with their own field | 50 [50, 50] | 100 [100, 100] |" in text
    assert "Round gates with their own field: 50 [50, 50] % of the tracks are crossed." in text
    assert "`loss.path_samples=1`" in text and "| 7.0 s |" in text
    assert reproduce(tmp_path, *args) == 0
    assert len(made) == len(rows) * 2 and len(sky.flown) == len(judged) * 6, "all is there"


def test_a_training_that_diverges_leaves_its_row_out(sky, made, tmp_path, monkeypatch, capsys):
    whole = training_run.train

    def train(config, folder, console, watch=None):
        if config.seed == 5 and config.episode.finish in worse:
            raise WorkFailed("training diverged at iteration 7")
        return whole(config, folder, console)

    monkeypatch.setattr(training_run, "train", train)
    args = ["ideas", "--trials", "1", "--difficulty", "0", "--training-seeds", "3", "5"]
    args += ["--only", "finish", "curriculum"]
    worse = {True}
    assert reproduce(tmp_path, *args) == 0
    text, found = page(tmp_path, "ideas")
    assert [row["key"] for row in found["rows"]] == ["recipe", "curriculum"]
    assert "left out, finish: seed 5: training diverged at iteration 7" in text
    worse.add(False)
    assert reproduce(tmp_path / "other", *args) == 1
    assert "the recipe itself, seed 5: training diverged" in capsys.readouterr().err


def test_a_change_that_does_not_go_with_the_recipe_is_found_before_anything_is_trained(
    sky, made, tmp_path, capsys
):
    args = ["ideas", "--preset", "paper", "--set", "loss.progress=0.5", "--only", "critic"]
    assert reproduce(tmp_path, *args) == 2 and not made
    assert "--only 'critic': loss.value is 0.5 and loss.crash_depth_m is inf" in (
        capsys.readouterr().err
    )
    rows = ideas(Config(preset="paper", set=()))
    left_out = refused_rows(rows, named=False)
    assert {"critic", "again"} < set(left_out) and "live on" not in left_out


@pytest.mark.slow
def test_round_gates_are_flown_by_the_trainers_own_code(tmp_path, monkeypatch):
    small = Config(
        set=(*SMALL, "episode.batch=2"), iterations=1, round_trials=2, round_seconds=0.5,
        only=("round",),
    )  # fmt: skip
    _, row = ideas(small)
    sampled = []

    def watched(config, iteration):
        sampled.append(sample_worlds(config, iteration))
        return sampled[-1]

    monkeypatch.setattr("suite.experiments.study.validation.sample_worlds", watched)
    looks = Looks(0, small.round_trials, small.round_seed, small.round_seconds)
    (found,) = train_one(Job((row.key, row.recipe), tmp_path / "run"), Console(), looks).points
    assert set(found) > {"success_cross", "success_rate", "v_max", "gates"}
    (worlds,) = sampled
    assert worlds.scene.gates.opening_g.shape == (2, 8, 8, 2)
    square = replace(row.recipe, episode=replace(row.recipe.episode, gate_corners=4))
    fewer = sample_worlds(square, 0).scene.boxes.center_w.shape[1]
    assert worlds.scene.boxes.center_w.shape[1] == fewer + 32


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--only", "second gat"], "Did you mean 'second gate'?"),
        (["--training-seeds", "1", "1"], "--training-seeds is 1 1"),
        (["--round-trials", "0"], "--round-trials is 0"),
        (["--round-seed", "2"], "--round-seed 2 is one of --training-seeds"),
        (["--round-seed", "-1"], "--round-seed is -1"),
        (["--workers", "0"], "--workers is '0'"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(
    args, words, made, tmp_path, capsys
):
    assert reproduce(tmp_path, "ideas", *args) == 2
    assert words in capsys.readouterr().err
    assert not made and not list(tmp_path.iterdir())
