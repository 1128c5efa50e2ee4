"""Settings changed by name."""

import math

import pytest

from suite.train.config import TrainConfig
from suite.train.overrides import check_owned, override
from suite.train.presets import preset


def test_settings_are_changed_by_name():
    changes = ("loss.progress=1.2", "episode.batch = 8", "physics.drag=(0, 0.5)", "seed=3")
    config = override(TrainConfig(), changes)
    assert config.loss.progress == 1.2 and config.episode.batch == 8 and config.seed == 3
    assert config.physics.drag == (0.0, 0.5) and isinstance(config.physics.drag[0], float)
    whole = override(TrainConfig(), ["loss.progress=1"]).loss.progress
    assert isinstance(whole, float) and whole == 1.0
    assert override(TrainConfig(), ["loss.crash_depth_m=inf"]).loss.crash_depth_m == math.inf
    camera = override(TrainConfig(), ["spec.camera.width=48"]).spec.camera
    assert camera.width == 48 and camera.height == TrainConfig().spec.camera.height


def test_what_only_the_point_mass_reads_is_refused_through_quadrotors():
    run = preset("direct")
    for change in ("physics.wind_std=(3,3,1)", "physics.action_delay=(0,2)"):
        with pytest.raises(ValueError, match=r"is of the point mass.*set one of quadrotor\."):
            override(run, [change])
    assert override(run, ["physics.image_delay=2"]).physics.image_delay == 2


@pytest.mark.parametrize(
    ("change", "need", "given"),
    [
        ("loss.projection_decay=1", "loss.projection", "3"),
        ("loss.speed_range=(3, 9)", "spec.speed_input", "True"),
        ("episode.race_share=0.9", "spec.speed_input", "True"),
    ],
)
def test_what_would_do_nothing_is_refused(change, need, given):
    run = preset("racer")
    with pytest.raises(ValueError, match=rf"does nothing where {need} is (0|False)"):
        override(run, [change])
    # In whatever order they are given.
    assert override(run, [change, f"{need}={given}"]) == override(run, [f"{need}={given}", change])


def test_what_a_command_sets_itself_is_refused_with_what_to_do_instead():
    check_owned(["loss.progress=1"], {"loss.prog": "", "spec": ""})
    with pytest.raises(ValueError, match=r"--set 'spec.rate_hz=30': this command sets spec"):
        check_owned(["spec.rate_hz=30"], {"spec": "take another policy"})


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("loss.progres=1", "Did you mean 'progress'"),
        ("los.progress=1", "Did you mean 'loss'"),
        ("loss=1", "has parts, set one of clearance"),
        ("loss.progress.more=1", "'more' is below a setting that has no parts"),
        ("quadrotor.mass_std=0.1", "this run has no quadrotor; take a preset"),
        ("loss.progress=inf", "loss.progress is inf, allowed is"),
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
