"""A run's configuration is a value: compared, hashed, and not changed in place."""

from dataclasses import FrozenInstanceError, fields, is_dataclass, replace

import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite.train.config import QuadrotorConfig, TrainConfig
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
