"""Training runs by name."""

import pytest

from suite.train.config import TrainConfig
from suite.train.presets import PRESETS, preset


@pytest.mark.parametrize("name", PRESETS)
def test_presets(name):
    config = preset(name)
    assert isinstance(config, TrainConfig) and PRESETS[name].__doc__
    assert config.optimizer.iterations > 0 and config.episode.batch > 0


def test_the_papers_preset_has_the_papers_weights():
    loss = preset("paper").loss
    assert (loss.clearance, loss.collide) == (3.0, 3.0)
    assert (loss.acceleration, loss.jerk, loss.progress) == (1e-2, 1e-3, 0.4)
    assert loss.field_decay == 0.3 and loss.progress_norm == loss.projection == 0.0
