"""Settings changed by name."""

import pytest

from suite.train.config import TrainConfig
from suite.train.overrides import override


def test_settings_are_changed_by_name():
    changes = ("loss.progress=1.2", "episode.batch = 8", "physics.drag=(0, 0.5)", "seed=3")
    config = override(TrainConfig(), changes)
    assert config.loss.progress == 1.2 and config.episode.batch == 8 and config.seed == 3
    assert config.physics.drag == (0.0, 0.5) and isinstance(config.physics.drag[0], float)
    whole = override(TrainConfig(), ["loss.progress=1"]).loss.progress
    assert isinstance(whole, float) and whole == 1.0
    camera = override(TrainConfig(), ["spec.camera.width=48"]).spec.camera
    assert camera.width == 48 and camera.height == TrainConfig().spec.camera.height


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("loss.progres=1", "Did you mean 'progress'"),
        ("los.progress=1", "Did you mean 'loss'"),
        ("loss=1", "has parts, set one of clearance"),
        ("loss.progress.more=1", "'more' is below a setting that has no parts"),
        ("quadrotor.mass_std=0.1", "this run has no quadrotor; add --model quad"),
        ("fleet.mass=1", "this run has no fleet; add --model fleet"),
        ("loss.progress", "write FIELD=VALUE"),
        ("loss.progress=fast", "'fast' does not fit, the setting is like"),
        ("episode.batch=3.5", "(int)"),
        ("physics.drag=(1,2,3)", "(tuple)"),
        ("physics.drag=(1,'a')", "(float)"),
    ],
)
def test_wrong_settings_are_refused_by_name(change, words):
    with pytest.raises(ValueError) as error:
        override(TrainConfig(), [change])
    assert words in str(error.value) and change in str(error.value)
