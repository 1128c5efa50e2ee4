"""A Delta Action Model is trained under in the dynamics that it was fitted to, and in no others."""

from dataclasses import replace
from pathlib import Path

import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from suite.delta.replay import check_corrects, corrected
from suite.train.config import PointMassConfig, QuadrotorConfig
from suite.train.presets import racer, swift
from tests.support.vehicles import with_lag
from tracks.common.files import plain

WHERE = Path("runs/delta/delta")


def kept(dynamics):
    """Return what stands in the checkpoint, as JSON gives it back."""
    import json

    return json.loads(json.dumps(plain({"iterations": 3, **corrected(dynamics)})))


def test_the_middle_of_the_ranges_is_what_counts():
    physics = swift().physics
    check_corrects(kept(physics), physics, 15.0, WHERE)
    check_corrects(kept(physics), replace(physics, drag=(0.0, 0.9), lag_std=0.0), 15.0, WHERE)
    check_corrects({}, physics, 15.0, WHERE)
    words = "drag 0.45 0.45 1.1 1/s.* this run's has .*drag 0.45 0.45 0.45 1/s.*--preset"
    with pytest.raises(ValueError, match=words):
        check_corrects(kept(physics), racer().physics, 15.0, WHERE)
    with pytest.raises(ValueError, match="delay 1 decisions; take"):
        check_corrects(kept(physics), replace(physics, action_delay=(0.5, 1.5)), 15.0, WHERE)


def test_of_a_vehicle_all_but_its_name_counts():
    vehicle = load_vehicle("reference")
    stored = kept(QuadrotorConfig(vehicle))
    check_corrects(
        stored, QuadrotorConfig(replace(vehicle, name="mine"), mass_std=0.0), 15.0, WHERE
    )
    other = replace(with_lag(vehicle, 0.05), name="other")
    with pytest.raises(ValueError, match="another vehicle than 'other'; take its --vehicle"):
        check_corrects(stored, QuadrotorConfig(other), 15.0, WHERE)
    with pytest.raises(ValueError, match="corrects --model quad, and this run has --model point"):
        check_corrects(stored, PointMassConfig(), 15.0, WHERE)
    with pytest.raises(ValueError, match="corrects --model point, and this run has --model quad"):
        check_corrects({}, QuadrotorConfig(vehicle), 15.0, WHERE)


def test_a_network_that_steps_at_another_rate_is_refused():
    physics = swift().physics
    fit = {**kept(physics), "rate_hz": 15.03}
    check_corrects(fit, physics, 15.0, WHERE)
    with pytest.raises(ValueError, match="of 15 decisions a second, and this run has 30: .*=15"):
        check_corrects(fit, physics, 30.0, WHERE)
