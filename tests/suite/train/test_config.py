"""Presets and settings by name."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from policies import shipped
from suite import cli
from suite.commands.train import Config, resolve
from suite.common.console import Console
from suite.judging.flying import checkpoint_folder
from suite.train.checks import check
from suite.train.config import TrainConfig
from suite.train.overrides import override
from suite.train.presets import PRESETS, preset
from suite.train.run import train
from suite.train.update import device_mesh
from suite.train.worlds import difficulty_range, sample_worlds
from tests.support.training import small_config


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


def test_an_unknown_preset_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match="Did you mean 'racer'"):
        resolve(Config(preset="rcaer"))


def test_options_become_settings():
    config = resolve(Config(preset="small", seed=4, iterations=7, set=("optimizer.rate=1",)))
    assert (config.seed, config.optimizer.iterations, config.optimizer.rate) == (4, 7, 1.0)


def test_difficulty_grows_from_its_lower_end():
    config = small_config(difficulty=(0.2, 0.8), easy_until=0.5)
    assert difficulty_range(config, 0) == (0.2, 0.2)
    assert difficulty_range(config, 3) == (0.2, 0.8) == difficulty_range(config, 5)
    at_once = replace(config, episode=replace(config.episode, easy_until=0.0))
    assert difficulty_range(at_once, 0) == (0.2, 0.8)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gate_corners": 2}, "episode.gate_corners is 2, allowed are 3 and more"),
        ({"height_spread": -1.0}, "episode.height_spread is -1.0, allowed are 0 and more"),
        ({"height_spread": float("nan")}, "episode.height_spread is nan"),
        ({"batch": 0}, "episode.batch is 0, allowed are 1 and more"),
        ({"stop_from": 1.5}, "episode.stop_from is 1.5, allowed are 0 to 1"),
        ({"gates": 9}, "episode.gates is 9, allowed are 1 to 8"),
        ({"difficulty": (0.5, 0.2)}, "episode.difficulty is .*lower end of the range first"),
        ({"physics": {"action_delay": (0.0, 3.0)}}, "physics.action_delay is .*allowed are 0 to 2"),
    ],
)
def test_worlds_that_cannot_be_made_are_refused_before_anything_is_written(
    changes, words, tmp_path
):
    with pytest.raises(ValueError, match=words):
        train(small_config(**changes), tmp_path / "run", Console())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("seed", [-1, 2**32])
def test_a_seed_that_no_key_is_made_of_is_refused(seed, tmp_path):
    with pytest.raises(ValueError, match=rf"seed is {seed}, allowed are 0 to 4294967295"):
        train(replace(small_config(), seed=seed), tmp_path / "run", Console())


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_within_the_limits(name):
    check(preset(name))


def test_gates_heights_follow_the_setting():
    usual, wide = (
        sample_worlds(small_config(batch=16, height_spread=share), 0).scene.gates.center_w[..., 2]
        for share in (1.0, 2.0)
    )
    assert np.ptp(wide, axis=1).mean() > 1.4 * np.ptp(usual, axis=1).mean()


def test_devices_that_are_not_there_or_do_not_divide_the_batch():
    have = len(jax.devices())
    with pytest.raises(ValueError, match=f"devices is {have + 1}, allowed is 0"):
        device_mesh(replace(small_config(), devices=have + 1))
    with pytest.raises(ValueError, match="devices is -1"):
        device_mesh(replace(small_config(), devices=-1))
    assert device_mesh(small_config()).size >= 1


def test_training_goes_on_from_a_shipped_policy_by_its_name(tmp_path, capsys):
    assert checkpoint_folder("racer", "--from") == shipped.folder("racer")
    assert cli.main(["train", "--from", "racr", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "--from racr: " in said and "a shipped policy's name (racer, swift" in said
    assert not (tmp_path / "run").exists()
