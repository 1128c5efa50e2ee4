"""A run's configuration is a value, and what no training can be made with is refused."""

from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite.common.console import Console
from suite.train.config import QuadrotorConfig, TrainConfig, check
from suite.train.presets import PRESETS, preset
from suite.train.run import train
from tests.support.training import small_config
from tracks.common.files import plain


def test_a_configuration_is_compared_and_hashed_by_value():
    config = TrainConfig()
    assert config == TrainConfig() and hash(config) == hash(TrainConfig())
    assert replace(config, seed=1) != config
    with pytest.raises(FrozenInstanceError):
        config.loss.progress = 2.0  # type: ignore[misc]


def test_a_configuration_can_be_kept_as_json_with_every_setting():
    config = replace(TrainConfig(), quadrotor=QuadrotorConfig(load_vehicle("reference")))
    kept = plain(config)
    for part in ("physics", "quadrotor", "loss", "episode", "optimizer"):
        value = getattr(config, part)
        assert is_dataclass(value) and set(kept[part]) == {field.name for field in fields(value)}
    assert kept["spec"]["rate_hz"] == 15.0 and plain(TrainConfig())["quadrotor"] is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"height_spread": -1.0}, "episode.height_spread is -1.0, allowed is 0 to 100"),
        ({"height_spread": float("nan")}, "episode.height_spread is nan"),
        ({"batch": 0}, "episode.batch is 0, allowed is 1 to 1000000"),
        ({"stop_from": 1.5}, "episode.stop_from is 1.5, allowed is 0 to 1"),
        ({"gates": 9}, "episode.gates is 9, allowed is 1 to 8"),
        ({"difficulty": (0.5, 0.2)}, "episode.difficulty is .*lower end of the range first"),
        ({"physics": {"action_delay": (0.0, 3.0)}}, "physics.action_delay is .*allowed is 0 to 2"),
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
    with pytest.raises(ValueError, match=rf"seed is {seed}, allowed is 0 to 4294967295"):
        train(replace(small_config(), seed=seed), tmp_path / "run", Console())


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_within_the_limits(name):
    check(preset(name))


@pytest.mark.parametrize("stride", [4, 7])
def test_a_stride_that_does_not_divide_the_steps_is_refused(stride):
    config = small_config(steps=6, image_stride=stride)
    with pytest.raises(ValueError, match=rf"image_stride is {stride}, allowed are divisors .*6"):
        check(config)
