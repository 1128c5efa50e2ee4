"""Training runs by name."""

import pytest

from suite import cli
from suite.train.config import TrainConfig
from suite.train.presets import PRESETS, preset


@pytest.mark.parametrize("name", PRESETS)
def test_presets(name):
    config = preset(name)
    assert isinstance(config, TrainConfig) and PRESETS[name].__doc__
    assert config.optimizer.iterations > 0 and config.episode.batch > 0


@pytest.mark.slow
def test_the_gpu_preset_trains_on_what_there_is_at_a_small_size(tmp_path):
    small = ["--iterations", "2", "--set", "episode.batch=8", "episode.steps=4"]
    assert cli.main(["train", "--preset", "gpu", *small, "--out", str(tmp_path / "run")]) == 0
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2


def test_the_papers_preset_has_the_papers_weights():
    loss = preset("paper").loss
    assert (loss.clearance, loss.collide) == (3.0, 3.0)
    assert (loss.acceleration, loss.jerk, loss.progress) == (1e-2, 1e-3, 0.4)
    assert loss.field_decay == 0.3 and loss.progress_norm == loss.projection == 0.0
