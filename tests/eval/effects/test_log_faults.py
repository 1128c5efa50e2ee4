"""A fault is written once, and serves logged arrays and simulated samples alike."""

from typing import cast

import jax.numpy as jnp
import numpy as np
import pytest

from eval.effects import EFFECTS
from eval.effects.interface import Effect, Parameter, Sample, as_arrays
from eval.effects.log_faults import apply_log_faults, lateness, measured, restored
from eval.effects.mass_offset import EFFECT as MASS
from tests.support.faults import ImuFault, with_imu_fault
from tests.support.flights import small_log
from tests.support.vehicles import PLAIN, drawn_effects
from tracks.geometry.rotation import exp_rot, quat_to_rot

FAULT = ImuFault((0.0, 0.0, 0.2), 1.1, 0.01)


def a_sample(rng, n=5):
    rot_w = exp_rot(rng.standard_normal((n, 3)))
    pos_w, vel_w, rate_b, acc_b = rng.standard_normal((4, n, 3))
    return Sample(pos_w, rot_w, vel_w, rate_b, acc_b)


def test_the_catalogue_undoes_its_own_faults_on_a_sample():
    rng = np.random.default_rng(2)
    drawn = {n: as_arrays(v) for n, v in drawn_effects(rng, PLAIN).effects.items()}
    sample = a_sample(rng)
    seen = measured(drawn, sample)
    np.testing.assert_array_equal(seen.rate_b, sample.rate_b + drawn["gyro_bias"].bias)
    np.testing.assert_array_equal(seen.acc_b, sample.acc_b + drawn["accelerometer_bias"].bias)
    assert lateness(drawn) == drawn["clock_offset"].offset
    for one, other in zip(restored(drawn, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert lateness({}) == 0.0 and measured({}, sample) is sample


@pytest.mark.parametrize("xp", [np, jnp])
def test_a_fault_of_another_package_acts_on_a_log(monkeypatch, xp):
    """It turns the frame, scales a channel and reads poses late, from one hook each."""
    with_imu_fault(monkeypatch)
    log = {name: xp.asarray(values) for name, values in small_log().items()}
    faulty = apply_log_faults({"imu_fault": FAULT}, log)
    np.testing.assert_allclose(faulty["rate_b"], 1.1 * log["rate_b"], rtol=1e-6)  # about z alone
    np.testing.assert_allclose(faulty["pos_w"][:, 0], 3.0 * (log["time_s"] - 0.01), atol=1e-6)
    heading = np.asarray(small_log()["time_s"]) - 0.01 + 0.2
    rot_w = np.asarray(quat_to_rot(faulty["quat_wxyz"]))
    np.testing.assert_allclose(np.arctan2(rot_w[:, 1, 0], rot_w[:, 0, 0]), heading, atol=1e-5)
    assert faulty["thrust_cmd"] is log["thrust_cmd"]


def test_a_small_fault_of_another_package_is_undone(monkeypatch):
    with_imu_fault(monkeypatch)
    sample = a_sample(np.random.default_rng(3))
    fault = {"imu_fault": as_arrays(ImuFault((1e-4, -2e-4, 3e-4), 1.0002, 0.0))}
    seen = measured(fault, sample)
    assert np.abs(seen.rate_b - sample.rate_b).max() > 1e-4
    for one, other in zip(restored(fault, seen), sample, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-6)


def test_what_is_added_must_be_an_effect_of_its_name():
    with pytest.raises(ValueError, match="'heavier'.*'mass_offset'.*the same"):
        EFFECTS.register("heavier", MASS)
    with pytest.raises(ValueError, match="must be an eval.effects.interface.Effect"):
        EFFECTS.register("heavier", cast(Effect, "heavier"))
    by_vehicle = Parameter("x", "1", lambda vehicle: vehicle.mass, 0.0, 1.0, (0.1, 0.2))
    fault = Effect("odd", "", "", "", tuple, (by_vehicle,), late=lambda values: values.x)
    with pytest.raises(ValueError, match="must be numbers"):
        EFFECTS.register("odd", fault)
    assert "odd" not in EFFECTS
