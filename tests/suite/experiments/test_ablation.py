"""The ablation at a size of seconds, and its rows by hand."""

import pytest

from eval.judging.statistics import wilson
from suite.common.errors import WorkFailed
from suite.experiments.ablation import Config, _comparison_grid, pooled, settings
from suite.experiments.pages.paper import ablation as printed
from suite.experiments.study.summary import Spread, summaries
from suite.experiments.study.training import TrainingResult
from suite.train import run as training_run
from tests.support.documents import page, reproduce
from tests.support.training import boxes_worlds

SMALL = ("spec.hidden_size=8", "spec.camera.width=20", "spec.camera.height=20", "episode.steps=6")
TINY = ["--set", *SMALL, "--iterations", "2", "--worlds", "2", "--trials", "3", "--seconds", "0.5"]


def test_settings_differ_in_field_and_progress_alone():
    rows = {row.key: row for row in settings(Config())}
    added = {"field 0.8", "field 1.2", "field 1.6", "field 3.2", "progress 1.2"}
    assert set(rows) - set(printed()[1]) == added
    losses = {key: row.recipe.loss for key, row in rows.items()}
    for key, loss in losses.items():
        kind, weight = key.split()
        assert (loss.field_gain > 0) == (kind == "field")
        normalised = kind == "normalised"
        assert (loss.progress_norm, loss.progress)[:: 1 if normalised else -1] == (float(weight), 0)
        assert rows[key].recipe.episode.gates == 4 and loss.projection == 0
    others = {str(row.recipe).replace(str(row.recipe.loss), "") for row in settings(Config())}
    assert len(others) == 1
    assert "field 0.4" in {row.key for row in settings(Config(recipe="paper"))}
    nearly = settings(Config(set=("loss.progress=0.4000001",)))
    assert [row.key for row in nearly].count("field 0.4") == 1
    assert len(settings(Config(recipe="paper"))) == 11, "its own weight is one of the paper's"


@pytest.mark.slow
def test_the_ablation_from_one_command_and_again(tmp_path, monkeypatch, capfd):
    args = [*TINY, "--only", "field 0.4", "normalised 6.4", "--training-seeds", "4"]
    train, made = training_run.train, []

    def diverging(config, folder, console, watch=None):
        made.append((config.loss.progress_norm, config.seed))
        if config.loss.progress_norm:
            raise WorkFailed("training diverged at iteration 1")
        return train(config, folder, console)

    monkeypatch.setattr(training_run, "train", diverging)
    monkeypatch.setattr("suite.train.run.sample_worlds", boxes_worlds)
    monkeypatch.setattr("suite.experiments.study.validation.sample_worlds", boxes_worlds)
    assert reproduce(tmp_path, "ablation", *args) == 0
    assert made == [(0, 4), (6.4, 4)]
    text, numbers = page(tmp_path, "ablation")
    field, normalised = numbers["rows"]
    assert (field["seeds"], field["diverged"]) == (1, 0)
    assert (normalised["seeds"], normalised["diverged"]) == (1, 1)
    # In half a second nobody passes four gates; who has not moved far hits nothing.
    assert field["over"]["success_cross"]["most"] == field["pooled"]["success_cross"]["low"] == 0
    assert field["over"]["collision_free"]["least"] == 1 and field["over"]["v_max"]["mean"] > 0
    assert "| without, L_p^norm | 6.4 | diverged | - |" in text and "| 1 of 1 |" in text
    assert "| 95 |" in text
    capfd.readouterr()
    monkeypatch.setattr("suite.train.run.make_update", None)
    assert reproduce(tmp_path, "ablation", *args) == 0, "nothing is trained again"
    assert (tmp_path / "docs" / "ablation.md").read_text() == text


def runs_of(key, *cross, rate=1.0, v_max=5.0):
    for seed, value in enumerate(cross):
        numbers = {"success_cross": value, "collision_free": rate, "v_max": v_max + seed,
                   "v_max_most": v_max + 2, "gates": 4.0}  # fmt: skip
        diverged = "" if value is not None else "it diverged"
        yield TrainingResult(key, seed, "", 60.0, 5.0, "c", diverged, [] if diverged else [numbers])


def test_spread_and_pooled_interval_by_hand():
    chosen = settings(Config(only=("field 0.4", "progress 3.2", "normalised 6.4")))
    runs = [
        *runs_of("field 0.4", 0.9, 1.0, 0.8),
        *runs_of("progress 3.2", 0.3, 0.1, None, rate=0.3),
        *runs_of("normalised 6.4", None),
    ]
    field, bare, gone = summaries(chosen, runs)
    assert field.at[-1]["success_cross"] == pytest.approx(Spread(0.9, 0.8, 1.0))
    assert field.at[-1]["v_max"] == Spread(6.0, 5.0, 7.0)
    assert pooled(field, "success_cross", 10) == wilson(27, 30)
    assert (bare.seeds, bare.diverged) == (3, 1)
    assert pooled(bare, "success_cross", 10) == wilson(4, 20)
    assert not gone.at and gone.diverged == 1
    line = [cell.text for cell in _comparison_grid([field], 10).rows[0]]
    assert line[2:5] == ["90 [80, 100]", "[74, 97]", "95"]
    assert line[8:11] == ["6.0 [5.0, 7.0]", "7.0", "6.5"]
