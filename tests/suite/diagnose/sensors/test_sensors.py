"""Sensors identified from estimates that a known model made."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from eval import sensors
from eval.logs.flight_log import FlightLog, write_flight
from eval.sensors.interface import Draws, View
from eval.sensors.sensors_file import load_sensors, sensor_set
from suite.common.console import Console
from suite.diagnose.sensors import colour, identify
from suite.diagnose.sensors.clock import Clock, clock_of, on_gyro_clock
from suite.diagnose.sensors.colour import Series, fit_colour
from suite.diagnose.sensors.errors import errors_of
from suite.diagnose.sensors.identify import fit_sensors, held_out, identify_sensors, parameters_of
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import exp_rot, rot_to_quat

STEP_S, LONG_S, FLIGHTS = 0.02, 40.0, 4
TRUE = {
    **{f"position_{a}": 0.03 for a in "xyz"},
    **{f"position_{a}_fast": 0.3 for a in "xyz"},
    **{f"velocity_{a}": size for a, size in zip("xyz", (0.1, 0.05, 0.2), strict=True)},
    **{f"velocity_{a}_lasts": lasts for a, lasts in zip("xyz", (0.3, 0.6, 0.15), strict=True)},
    **{f"attitude_{a}": 0.01 for a in "xyz"},
    **{f"attitude_{a}_bias": 0.02 for a in "xyz"},
    "velocity_scale": 0.05,
}
DELAY_S = 0.06
GROUPS = (("pos_w", "pos", "xyz"), ("vel_w", "vel", "xyz"), ("rot_w", "quat", "wxyz"))
"""Parts of an estimate: as the sensors see it, as it is logged, and their axes."""


def flown(
    numbers: Sequence[int],
    delay_s: float = DELAY_S,
    drag: float = 0.0,
    long_s: float = LONG_S,
    **changed: float,
) -> list[FlightLog]:
    """Return flights with an estimate by a model of `TRUE` that is late by `delay_s`.

    Its tilt errs by a neglected `drag`, with a correlation time of 0.8 s.
    """
    lead, count = round(delay_s / STEP_S), round(long_s / STEP_S)
    time_s = STEP_S * np.arange(-lead, count)
    drawn = np.array([np.random.default_rng(number).uniform(size=(2, 3)) for number in numbers])
    speed = 1.0 + 0.6 * drawn[:, 0]
    phase = speed * time_s[:, None, None] + 6.0 * drawn[:, 1]  # (T, N, 3)
    pos_w, vel_w = 3.0 * np.sin(phase), 3.0 * speed * np.cos(phase)
    rot_w = exp_rot(0.3 * np.sin(phase + 1.0))
    turn = np.swapaxes(rot_w[:-1], -1, -2) @ rot_w[1:]
    between_b = np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1) / STEP_S
    rate_b = np.concatenate([between_b[:1], 0.5 * (between_b[:-1] + between_b[1:])])
    wanted = {"measured_state": {**TRUE, **changed}, "drag_tilt": {"drag": drag, "lasts": 0.8}}
    models = sensors.view_models(sensor_set(wanted).models)
    sensor, camera, rng = sensors.SENSORS["measured_state"], Camera(), np.random.default_rng(99)
    none: Any = np.zeros((len(numbers), 0))

    def draws(count: int) -> dict[str, Draws]:
        drawn = Draws(rng.normal(size=(len(numbers), count)), *[none] * 3)
        return {"measured_state": drawn, "drag_tilt": Draws(*[none] * 4)}

    seen, memory = [], None
    for place in zip(pos_w, rot_w, vel_w, strict=True):
        view = View(*place, *[none] * 4)
        if memory is None:
            memory = sensors.start(models, view, draws(sensor.trial.normal), STEP_S, camera)
        now = draws(sensor.observation.normal)
        view, memory = sensors.sense(models, memory, view, now, STEP_S, camera)
        seen.append(view)
    rows, logs = slice(lead, len(time_s) - 1), []
    for k, number in enumerate(numbers):
        estimate = {}
        for view_name, name, axes in GROUPS:
            part = np.stack([getattr(view, view_name)[k] for view in seen[: count - 1]])
            part = rot_to_quat(part) if name == "quat" else part
            estimate |= {f"est_{name}_{a}": part[:, i] for i, a in enumerate(axes)}
        log = FlightLog(
            f"flight{number}", time_s[rows], pos_w[rows, k], rot_to_quat(rot_w[rows, k]),
            vel_w[rows, k], rate_b[rows, k], np.full(count - 1, 9.81), rate_b[rows, k],
            extra=estimate,
        )  # fmt: skip
        logs.append(log)
    return logs


flights, fitted = cache(lambda: flown(range(FLIGHTS))), cache(lambda: fit_sensors(flights()))
short = cache(lambda: flown(range(2), long_s=15.0))
"""Two flights, for tests that are not about the size of intervals."""


def parts(log, group):
    """Return the log with one group of its estimate, which fits faster than three."""
    return replace(log, extra={k: v for k, v in log.extra.items() if k.startswith(f"est_{group}")})


def test_the_true_parameters_are_within_the_intervals():
    found = parameters_of(fitted())
    true = {f"measured_state.{name}": value for name, value in TRUE.items()}
    for axis in (f"{group}_{a}" for group in ("position", "attitude") for a in "xyz"):
        true.setdefault(f"measured_state.{axis}_lasts", 0.5)
    true["delay.state"] = DELAY_S
    missed = {k: v for k, v in true.items() if not found[k][0].low <= v <= found[k][0].high}
    # One in twenty of the intervals may miss.
    assert len(missed) <= 0.05 * len(true) + 2, missed
    assert "delay.state" not in missed
    delay, noise = (found[name][0] for name in ("delay.state", "measured_state.velocity_z"))
    assert delay.high - delay.low < 0.02 and noise.high / noise.low < 1.5


@pytest.mark.slow
def test_the_noise_fits_held_out_flights_unless_theirs_has_another_colour():
    assert all(one.fits for one in held_out(flights()).values())
    others = flown(range(9, 12), velocity_z_lasts=2.0)
    mixed = [flight for pair in zip(flights()[:3], others, strict=True) for flight in pair]
    assert not held_out(mixed)["velocity_z"].fits


@pytest.mark.slow
def test_a_drift_and_a_tilt_by_neglected_drag_are_found_where_they_are():
    none = {"position_x": 0.0, "position_y": 0.0}
    drifting = flown(range(20, 22), 0.0, position_drift=0.05, **none)
    drift = fit_sensors(drifting).axes["position_x"].drift
    assert drift.low <= 0.05 <= drift.high and drift.value > 0.02
    assert not fitted().systematic.drag.value
    drag, lasts_s = fit_sensors(flown(range(30, 36), drag=0.4)).systematic[2:]
    assert drag.value == pytest.approx(0.4, abs=0.01)
    assert lasts_s.value == pytest.approx(0.8, abs=0.04)
    assert drag.high - drag.low < 0.05


@pytest.mark.extended
def test_a_flight_without_a_part_of_the_estimate_does_not_count_for_it():
    has, lacks = (parts(log, group) for log, group in zip(short(), ("vel", "quat"), strict=True))
    one, two = (fit_sensors(logs) for logs in ([has], [has, lacks]))
    assert one.systematic.delay_s.value == pytest.approx(two.systematic.delay_s.value, abs=0.005)
    for axis in ("velocity_x", "velocity_y", "velocity_z"):
        assert two.axes[axis].noise.value == pytest.approx(one.axes[axis].noise.value, rel=0.1)


def test_a_wandering_clock_is_found_by_the_gyro_and_leaves_no_errors():
    log = flights()[0]
    assert not clock_of(log).shift_s.any()
    true_s = 0.08 * np.sin(0.2 * log.time_s)
    # The reference is earlier by as much as the gyro and the estimate are late.
    off = on_gyro_clock(log, Clock(log.time_s, -true_s))
    found = clock_of(off)
    error_s = found.shift_s - np.interp(found.time_s, log.time_s, true_s)
    assert np.sqrt((error_s**2).mean()) < 0.01
    logs = (log, off, on_gyro_clock(off, found))
    rms = [np.sqrt(np.nanvar(errors_of(one, DELAY_S).value[:, :3])) for one in logs]
    assert rms[1] > 2.0 * rms[0] and rms[2] < 1.1 * rms[0]


def test_the_file_that_is_written_reads_back_with_what_was_found(tmp_path):
    file = tmp_path / "mine.toml"
    for number, log in enumerate(short()):
        write_flight(tmp_path / f"{number}.parquet", parts(log, "vel"))
    found, read = identify_sensors([tmp_path], file, Console())["parameters"], load_sensors(file)
    noise, delay_s = (found[k]["value"] for k in ("measured_state.velocity_z", "delay.state"))
    assert read.models["measured_state"].velocity_z == pytest.approx(noise, rel=1e-3)
    assert read.ages.state_s == pytest.approx(delay_s, rel=1e-3)
    assert "95 % intervals" in file.read_text()


def test_an_estimate_ahead_of_its_reference_has_no_delay_in_the_file_and_a_warning(
    tmp_path, monkeypatch
):
    log = parts(short()[0], "vel")
    late = Clock(log.time_s, np.full(len(log.time_s), DELAY_S + 0.05))
    write_flight(tmp_path / "log.parquet", on_gyro_clock(log, late))
    # The gyro shows the shift, which would be removed.
    monkeypatch.setattr(identify, "clock_of", lambda log: Clock(np.zeros(1), np.zeros(1)))
    found = identify_sensors([tmp_path], tmp_path / "mine.toml", Console())
    assert found["parameters"]["delay.state"]["ci95"][1] < 0.0
    assert load_sensors(tmp_path / "mine.toml").ages.state_s == 0.0
    (warning,) = [text for text in found["warnings"] if text.startswith("delay.state: these")]
    assert "the file has 0, the nearest allowed value" in warning


def test_a_log_without_an_estimate_or_a_reference_is_refused(tmp_path):
    log = short()[0]
    bare = replace(log, extra={})
    lost = replace(log, pos_w=np.full_like(log.pos_w, np.nan), about={"partial": ["pos"]})
    brief = flown([1], long_s=1.5, delay_s=0.0)[0]
    for one, words in (
        (brief, r"bare.parquet: 1.5 s of flight; allowed are 12 s or more"),
        (bare, r"bare.parquet: no on-board estimate.*est_vel_x.*--source estimate is left out"),
        (lost, "column pos_x: no reference for the estimate"),
    ):
        write_flight(tmp_path / "bare.parquet", one)
        with pytest.raises(ValueError, match=words):
            identify_sensors([tmp_path], tmp_path / "mine.toml", Console())


def test_the_correlation_of_logs_with_other_rates_is_compared_at_equal_lags():
    fine = np.convolve(np.random.default_rng(1).normal(size=40_000), np.ones(30), "valid")
    lag_s = 0.02 * np.arange(10)
    both = [Series(fine[::k], 0.0 * fine[::k], 0.01 * k) for k in (1, 2)]  # 100 Hz and 50 Hz
    found = identify._autocorrelation(both, lag_s)
    np.testing.assert_allclose(found, 1.0 - lag_s / 0.3, atol=0.05)


SD, LASTS_S, DRIFT, SPEED, SPAN_S, ROWS = 0.03, 0.2, 0.05, 3.0, 60.0, 600


def exact(flights, lag_s, about_mean=False):
    """Return two stretches with the expected variogram, and the variance about a flight's mean.

    The noise decays with `LASTS_S` (its mean: Taylor 1921). A walk W(t) of the variance d a second
    has the variogram d l / 2, and about its mean over D the variance d D / 6.
    """
    per_s, ratio = DRIFT**2 * SPEED, LASTS_S / SPAN_S
    value = SD**2 * (1.0 - np.exp(-lag_s / LASTS_S)) + 0.5 * per_s * lag_s
    if about_mean:
        of_mean = 2.0 * ratio * (1.0 - ratio * (1.0 - np.exp(-1.0 / ratio)))
        value = np.append(value, SD**2 * (1.0 - of_mean) + per_s * SPAN_S / 6.0)
    half = np.full((2, len(value)), 0.5)
    return colour._Variograms(2.0 * half * value, half, np.full((2, 1), SPEED), np.arange(2))


def test_a_drift_and_the_noise_around_it_have_their_true_sizes(monkeypatch):
    monkeypatch.setattr(colour, "_variograms", exact)
    flight = Series(np.zeros(ROWS), np.full(ROWS, SPEED), SPAN_S / ROWS)
    found = fit_colour([flight, flight])
    assert found is not None
    fitted = found.noise.value, found.lasts_s.value, found.drift.value
    # At the shortest lag of the drift's fit, 2 s, exp(-10) of the noise is still correlated.
    assert fitted == pytest.approx((SD, LASTS_S, DRIFT), rel=1e-3)


def test_the_correlation_time_of_slow_logs_has_no_bias():
    step_s, lasts_s = 0.05, 0.1
    decay, found = np.exp(-step_s / lasts_s), []
    for seed in range(12):
        drawn = np.random.default_rng(seed).standard_normal((3, 1200))
        noise = lfilter([np.sqrt(1.0 - decay**2)], [1.0, -decay], drawn, axis=1)
        found.append(fit_colour([Series(one, 0.0 * one, step_s) for one in noise]).lasts_s.value)
    assert np.median(found) == pytest.approx(lasts_s, rel=0.05)


def test_one_row_after_the_last_whole_stretch_is_left_out():
    noise = np.random.default_rng(2).normal(size=2001)
    found = [fit_colour([Series(noise[:n], np.zeros(n), 0.02)] * 2) for n in (2000, 2001)]
    assert found[0] and found[1]
    assert found[1].noise.value == pytest.approx(found[0].noise.value, rel=0.01)


def test_a_drift_of_flights_is_significant_and_within_its_interval():
    rng, count, step_s = np.random.default_rng(3), 60, 0.1
    steps = DRIFT * np.sqrt(SPEED * step_s) * rng.normal(size=(count, 4, ROWS))
    values = SD * rng.normal(size=steps.shape) + steps.cumsum(axis=2)
    speed, found = np.full(ROWS, SPEED), []
    for each in values:
        found.append(colour._drift([Series(value, speed, step_s) for value in each]))
    assert sum(drift.low > 0.0 for drift in found) > 0.6 * count
    assert sum(drift.low <= DRIFT <= drift.high for drift in found) > 0.85 * count
    assert np.median([drift.value for drift in found]) == pytest.approx(DRIFT, rel=0.1)


def test_rows_without_a_velocity_are_not_rows_at_rest():
    speed = np.full(ROWS, SPEED)
    speed[50:90] = np.nan
    value = np.where(np.isnan(speed), np.nan, np.random.default_rng(5).normal(size=ROWS))
    found = colour._variograms([Series(value, speed, 0.1)], np.array([1.0]))
    assert found is not None
    np.testing.assert_allclose(found.speed, SPEED)
