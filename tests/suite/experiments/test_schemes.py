"""The comparison of training schemes at a size of seconds, and its numbers by hand."""

import json

import pytest

from suite.experiments.ablation import Config as AblationConfig
from suite.experiments.ablation import settings
from suite.experiments.scheme_curves import first_times, summaries, value_at
from suite.experiments.scheme_tables import verdict
from suite.experiments.schemes import Config, Learnt, curve_of, schemes
from suite.experiments.seed_intervals import Spread
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


def test_the_comparison_from_one_command_and_again(tmp_path, monkeypatch):
    for module in ("suite.train.run", "suite.train.ppo.run", "suite.experiments.validation"):
        monkeypatch.setattr(f"{module}.sample_worlds", boxes_worlds)
    args = [*TINY, "--only", "ours", "ppo", "--training-seeds", "4"]
    assert reproduce(tmp_path, "schemes", *args) == 0
    text, numbers = page(tmp_path, "schemes")
    assert [row["scheme"] for row in numbers["rows"]] == ["ppo", "ours"]
    for row in numbers["rows"]:
        assert row["steps"] == [0, 4 * 6, 2 * 4 * 6] and row["time"][0] == 0 < row["time"][1]
        assert row["curves"]["success_rate"][0]["mean"] == 1.0
        assert row["compile_s"] > 0 and row["reached"]["1"] == []
    # Before the first step both are the same network in the same worlds.
    one, two = (row["curves"]["reward"][0] for row in numbers["rows"])
    assert one["mean"] == pytest.approx(two["mean"]) and one["mean"] != 0
    assert "not reached" in text and "The paper has ours ahead of PPO" in text
    for module in ("suite.train.run", "suite.train.ppo.run"):
        monkeypatch.setattr(f"{module}.make_update", None)
    assert reproduce(tmp_path, "schemes", *args) == 0, "nothing is trained again"
    assert (tmp_path / "docs" / "schemes.md").read_text() == text


def test_time_leaves_compilation_out(tmp_path):
    seconds = [(0, 30.0, True), (1, 2.0, False), (2, 11.0, True), (3, 3.0, False), (4, 4.0, False)]
    rows = [{"iteration": k, "seconds": s, "cold": cold} for k, s, cold in seconds]
    watched = [{"iteration": k, "gates": float(k)} for k in (0, 3, 5)]
    for name, lines in (("metrics.jsonl", rows), ("validation.jsonl", watched)):
        (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    points, compiling = curve_of(tmp_path, 10)
    assert [(p["steps"], p["time"], p["gates"]) for p in points] == [
        (0, 0.0, 0.0), (30, 3 + 2 + 3, 3.0), (50, 3 + 2 + 3 + 3 + 4, 5.0),
    ]  # fmt: skip
    assert compiling == 27 + 8


def learnt(scheme, seed, pace, gates, diverged=""):
    """Return a run measured at 0, 100 and 200 steps."""
    points = [
        {"steps": 100.0 * k, "time": pace * k, "gates": g, "reward": 10 * g, "v_max": 4.0,
         "success_rate": 1.0, "success_cross": g / 4}
        for k, g in enumerate(gates)
    ]  # fmt: skip
    return Learnt(scheme, seed, points, 5.0, "c", diverged)


def test_curves_first_times_and_sentences_by_hand():
    chosen = schemes(Config(only=("ours", "ppo")))
    runs = [
        learnt("ppo", 0, 4.0, [0.0, 0.5, 1.5]),
        learnt("ppo", 1, 4.0, [0.0, 0.5, 0.5]),
        learnt("ours", 0, 1.0, [0.0, 1.0, 3.0]),
        learnt("ours", 1, 3.0, [0.0, 2.0, 4.0]),
        learnt("ours", 2, 3.0, [0.0], "it diverged"),
    ]
    ppo, ours = summaries(chosen, runs)
    assert ours.steps == [0, 100, 200] and ours.time == [0, 2, 4] and ours.diverged == 1
    assert ours.curves["gates"][1:] == [Spread(1.5, 1.0, 2.0), Spread(3.5, 3.0, 4.0)]
    assert ours.reached[2] == [(200, 2.0), (100, 3.0)] and ours.reached[3] == [(200, 2), (200, 6)]
    assert ppo.reached[1] == [(200, 8.0)] and ppo.reached[2] == []
    assert first_times([], 1) == []
    assert value_at(ppo, "gates", 4.0).mean == 0.5 and value_at(ppo, "gates", 3.9).mean == 0
    said = verdict([ppo, ours])
    assert "ours: 3.50 gates" in said.lower() and "(8.0 s of training)" in said
    assert "ahead at the end in reward, gates (with every seed above every one of PPO's" in said
    assert "after 4.0 s of training each in reward, gates" in said
    swapped = verdict([ppo._replace(curves=ours.curves), ours._replace(curves=ppo.curves)])
    assert "ahead at the end in none of them" in swapped
    gone = summaries(chosen[:1], [learnt("ppo", 0, 4.0, [0.0], "it diverged")])
    assert verdict(gone) == "Every training of PPO diverged."


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--seed", "0"], "--seed 0 is one of --training-seeds"),
        (["--only", "pop"], "Did you mean 'ppo'?"),
        (["--worlds", "6"], "--worlds is 6, allowed with PPO are multiples of its 4 minibatches"),
        (["--measurements", "0"], "--measurements is 0"),
        (["--set", "loss.progress=1.2"], "this experiment sets loss.progress; give --progress"),
        (["--set", "loss.projection=1"], "this experiment sets loss.projection; it is compared"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_trained(args, words, tmp_path, capsys):
    assert reproduce(tmp_path, "schemes", *args) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
