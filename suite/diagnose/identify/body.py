"""Fits thrust and drag to the body's translation, and inertia, lag and delay to its rotation.

Force fit: the model is compared with the measured acceleration, given the measured attitude. If no
flight has an attitude, the thrust is assumed to point along the path's acceleration minus gravity,
and only its size is compared (differential flatness; Mellinger and Kumar 2011).

Torque fit: the model is compared with changes of the measured body rates, given the signals that
drive the rotors.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.steps import torque_between_rows
from suite.diagnose.data.view import FlightRows, WeakForm
from suite.diagnose.estimate.block import less_nuisance
from suite.diagnose.estimate.gauss_newton import TINY
from suite.diagnose.identify.drive import DRIVES, Accelerations, DrivenVehicle
from suite.diagnose.identify.fit import (
    NONE_KNOWN,
    Z95,
    Fitted,
    KnownNumbers,
    Residuals,
    Rows,
    Unknown,
    fit,
    rms_of,
)
from suite.diagnose.identify.grid import (
    IMU_ACC,
    LEANING,
    POSE_SLOPE,
    ROTOR_NOISE,
    VELOCITY_NOISE,
    FlightGrid,
)

FORCE_WIDTH_S = 0.4
"""Width of the windows over which forces are averaged [s]."""
BLOCK_S = 2.0
"""Length of a block of time; errors of different blocks count as independent [s]."""
SLOW_M_S = 2.0
"""Largest speed of the windows that are used without an attitude. A drag across the thrust would
add to the thrust's size, by 0.3 % at this speed and a drag of 0.4 1/s [m/s]."""
MOST_ERROR = 0.2
"""Largest share of an estimated velocity's variance that is error, for an identifiable drag."""
FORCE_ERROR = 0.05
"""Usual error of a force averaged over a window [m/s^2]."""
FORCE_OFFSETS = np.array([True, True, False])
"""Body axes along which each flight has a free constant, for its trim (error of the attitude).
Along z a constant would be mistaken for thrust."""
TORQUE_WIDTH_S = 0.2
"""Width of the windows in which changes of rate are compared [s]."""
TO_RATE_S = TORQUE_WIDTH_S / (2.0 * np.pi)
"""Factor from an angular acceleration to the change of rate that is compared in a window. The mean
over the window is removed: the slow part of the motors' torque only balances trim and blade
flapping, and does not turn the body [s]."""
NOISE_BIASED = ("inertia_x", "inertia_y", "yaw")
"""For each body axis, the number that noise of the rotor speeds biases."""
FORCE_NUMBERS = ("thrust", "curve", "battery")
"""Numbers of the force fit on which the torque depends."""
LATEST_S, LATE_STEP_S = 0.13, 0.012
"""Largest total delay that is tried for the start of a fit, and the step between trials [s]."""


def force_unknowns(
    driven: DrivenVehicle, voltage: bool, leaning: bool = False, scale: float = 0.0
) -> list[Unknown]:
    """Return the numbers that the force fit estimates, with their start in the vehicle file.

    With `leaning`, no flight has an attitude, and drag is fitted along body z only. `scale` is the
    logarithm of the thrust's scale in the vehicle file.
    """
    method_error = 0.004 if leaning else 0.001
    unknowns = [Unknown("thrust", scale, -2.0, 2.0, 0.25, 1e-3, method_error)]
    if driven.drive == "pwm":
        unknowns.append(Unknown("curve", driven.curve, -0.1, 1.0, 0.35, 1e-2, 0.02))
        if voltage:
            exponent = driven.motors.voltage_exponent
            unknowns.append(Unknown("battery", exponent, 0.0, 4.0, 0.6, 1e-2, 0.02))
    for axis, start in list(zip("xyz", driven.drag, strict=True))[2 if leaning else 0 :]:
        unknowns.append(Unknown(f"drag_{axis}", start, -2.0, 5.0, 0.25, 1e-2, 0.004))
    return unknowns


def fit_force(
    unknowns: Sequence[Unknown],
    flights: Sequence[FlightGrid],
    driven: DrivenVehicle,
    fixed: Mapping[str, float],
) -> Fitted:
    """Fit the numbers of thrust and drag.

    All flights have velocities; all or none have an attitude. `fixed` are other numbers, `lag` and
    `late` (total delay) among them.

    Raises:
        NoWholeWindow: if no window has all signals.
    """
    windows = [_force_windows(flight, driven.drive) for flight in flights]

    def residuals(numbers: Mapping[str, float]) -> list[Rows]:
        vehicle = driven.accelerations(numbers)
        return [one.residuals(vehicle(one.flight, one.rows)[0]) for one in windows]

    held = _without_motion(windows)
    held = [unknown.name for unknown in unknowns if unknown.name in held]
    fitted = fit(residuals, unknowns, held, fixed=fixed)
    return replace(fitted, measured_rms=_measured_rms(windows))


class Windows(NamedTuple):
    """M windows of one flight, over which C measured values are averaged."""

    flight: FlightGrid
    rows: FlightRows
    """The flight as rows of a view, with the attitude that the fit uses."""
    form: WeakForm
    """Weights of the windows: `form.mean @ values` are means of `values` over the windows."""
    measured: np.ndarray
    """(M, C) measured means; vectors (M, 3) in world axes if there is `to_body`."""
    offset: np.ndarray
    """(C,) bool: channels in which the flight has a free constant."""
    to_body: np.ndarray | None = None
    """(M, C, 3) rotation of the residuals from world axes to C body axes; None for none."""
    nuisance: np.ndarray | None = None
    """(M, C, K) change of the residuals by the uncertainties of a pose by inertia."""

    def residuals(self, modelled: np.ndarray) -> Rows:
        """Return measured minus modelled means; `modelled` (G, C) are values on the grid."""
        error = self.measured - self.form.mean @ np.nan_to_num(modelled)
        if self.to_body is not None:
            error = (self.to_body @ error[..., None])[..., 0]
        block = (self.form.middle_s / BLOCK_S).astype(int)  # number of the block of time
        return Rows(error, block, self.offset, self.nuisance)

    def means(self, values: np.ndarray) -> np.ndarray:
        """Return the means (M, 3, K) of `values`, (G, 3) or (G, 3 K), over the windows."""
        return np.reshape(self.form.mean @ values, (len(self.form.middle_s), 3, -1))


def _measured_rms(flights: Sequence[Windows]) -> np.ndarray:
    """Return the root mean square (C,) of the measured means, as `fit` computes it of residuals."""
    return rms_of([one.residuals(np.zeros((one.form.mean.shape[1], 3))) for one in flights])


def _force_windows(flight: FlightGrid, drive: str) -> Windows:
    """Return the windows of `flight` for its acceleration, where all signals are present."""
    # The measured acceleration is that of the accelerometer, or follows from the velocity.
    motion = IMU_ACC if flight.has(IMU_ACC) else "vel_w"
    attitude = "rot_w" if flight.has("rot_w") else LEANING
    needs = (motion, DRIVES[drive][0], attitude)
    rows, form = flight.rows(attitude_of_path=True), flight.form(FORCE_WIDTH_S, needs)
    axes = slice(0, 3)
    if attitude == LEANING:  # only along the thrust, and only slow flight
        speed = np.linalg.norm(rows.motion.vel_w, axis=1)
        slow, axes = form.mean @ speed < SLOW_M_S, slice(2, 3)
        form = form.take(slow)
    to_acceleration = form.mean if motion == IMU_ACC else form.change
    measured_w = to_acceleration @ np.nan_to_num(flight.signals[motion])
    to_body = np.swapaxes(flight.signals[attitude][form.middle_row], 1, 2)[:, axes]
    windows = Windows(flight, rows, form, measured_w, FORCE_OFFSETS[axes], to_body)
    if not flight.has(POSE_SLOPE):
        return windows
    return windows._replace(nuisance=windows.means(flight.signals[POSE_SLOPE])[:, axes])


def _without_motion(flights: Sequence[Windows]) -> list[str]:
    """Return the drags along x and y that flights without a pose do not show, by name.

    An estimated velocity that is mostly error has no relation to the force, so its drag would be 0
    (errors in variables; Fuller 1987, Sec. 1.1). What the uncertainties of the pose explain is
    removed from the compared variances of velocity and error.
    """
    error, total = np.zeros(2), np.zeros(2)
    for one in flights:
        if one.nuisance is None:
            continue
        signals = (one.rows.vel_b, one.flight.signals[VELOCITY_NOISE])
        values = np.concatenate([one.means(signal) for signal in signals], axis=2)
        values, slopes = ((v - v.mean(axis=0))[:, :2] for v in (values, one.nuisance))
        values = less_nuisance(slopes / FORCE_ERROR, values)
        total += (values[..., 0] ** 2).sum(axis=0)
        error += (values[..., 1:] ** 2).mean(axis=-1).sum(axis=0)
    return [f"drag_{axis}" for k, axis in enumerate("xy") if error[k] > MOST_ERROR * total[k]]


def lag_unknowns(lag_s: float, late_s: float) -> list[Unknown]:
    """Return the numbers `late` and `lag`, which start at `late_s` and `lag_s` [s].

    `late` is the sum of the rotors' `lag` and a pure delay. Slow flights identify only the sum.
    """
    late = Unknown("late", late_s, -0.02, 0.3, 0.012, 1e-3, 0.0007)
    return [late, Unknown("lag", lag_s, 0.0, 0.3, 0.012, 1e-3, 0.0007)]


def torque_unknowns(drive: str, lag_s: float, late_s: float) -> list[Unknown]:
    """Return the numbers that the torque fit estimates, logarithms of ratios but for lag and delay.

    `inertia_z` is relative to the mean of the other two, and keeps this ratio if it is not
    identifiable. `yaw` is the yaw torque over the inertia about z, unless torques are commanded.
    """
    unknowns = [Unknown(f"inertia_{a}", 0.0, -5.0, 5.0, 0.5, 1e-2, 0.015) for a in "xy"]
    widest_z = 0.5 if drive == "torques" else 0.25
    unknowns.append(Unknown("inertia_z", 0.0, -1.0, 1.0, widest_z, 1e-2, 0.015))
    if drive != "torques":
        unknowns.append(Unknown("yaw", 0.0, -5.0, 5.0, 0.5, 1e-2, 0.015))
    return unknowns if drive == "rotors" else [*unknowns, *lag_unknowns(lag_s, late_s)]


def fit_torque(
    unknowns: Sequence[Unknown],
    flights: Sequence[FlightGrid],
    driven: DrivenVehicle,
    fixed: Mapping[str, float],
    known: KnownNumbers = NONE_KNOWN,
    held: Sequence[str] = (),
    lag_known: bool = False,
) -> Fitted:
    """Fit inertia, lag and delay by `dw/dt = J^-1 (tau - w x J w)`.

    Here w are the body rates, tau is the torque and J the inertia.

    Noise in measured rotor speeds makes the modelled torque noisy, and a fit to a noisy input gives
    too small a slope (errors in variables; Fuller 1987, Sec. 1.1). The inertia would seem larger
    and the yaw torque smaller. The modelled torque is therefore multiplied by the share of its
    variance that is not noise (the reliability ratio). Half of this correction counts as its
    uncertainty. The same holds for the torque between the rows of the log (`torque_between_rows`),
    but without an identified lag (`lag_known`) it counts as uncertainty only.

    A number that reaches its limit is reset to its start and held. So are the numbers `held`, with
    their uncertainty. `fixed` has the other numbers, `lag` and `late` among them; `known` are those
    that the force fit has identified, with their covariance.

    Raises:
        NoWholeWindow: if no window has all signals.
    """
    # The known numbers join the unknowns, so that their uncertainty widens the intervals.
    steps = {"thrust": 1e-3, "curve": 1e-2, "battery": 1e-2}
    known_unknowns = (Unknown(n, fixed[n], -9.0, 9.0, 1.0, steps[n]) for n in known.names)
    unknowns = [*unknowns, *known_unknowns]
    held = list(held)
    windows = [_torque_windows(flight, driven.drive) for flight in flights]
    # Correct the bias by noise of the rotor speeds, and by the torque between the rows.
    starts = {**fixed, **{unknown.name: unknown.start for unknown in unknowns}}
    reliability = between_rows = np.ones(3)
    if driven.drive == "rotors":
        reliability = _reliability(windows, driven.accelerations(starts))
        lag_s, spacing_s = fixed["lag"], float(np.mean([one.rotor_spacing_s for one in flights]))
        vehicle = replace(driven.start, rotors=replace(driven.start.rotors, time_constant=lag_s))
        between_rows = 1.0 + torque_between_rows(vehicle, spacing_s)
    uncertain = 0.5 * np.hypot(np.log(reliability), np.log(between_rows))
    correction: dict[str, float] = dict(zip(NOISE_BIASED, uncertain, strict=True))
    reliability = reliability * between_rows if lag_known else reliability
    for k, u in enumerate(unknowns):
        of_noise = Z95 * correction.get(u.name, 0.0)
        unknowns[k] = u._replace(method_error=float(np.hypot(u.method_error, of_noise)))

    def residuals(numbers: Mapping[str, float]) -> list[Rows]:
        vehicle = driven.accelerations(numbers)
        return [one.residuals(TO_RATE_S * _turning(vehicle, one, reliability)) for one in windows]

    # The fit is linearised, so it needs a start near the right delay.
    if any(unknown.name == "late" for unknown in unknowns):
        measured = [one.measured for one in windows]
        late_s = _best_correlated_delay(residuals, starts, measured)
        unknowns = [u._replace(start=late_s) if u.name == "late" else u for u in unknowns]
    while True:
        fitted = fit(residuals, unknowns, held, known, fixed=fixed)
        at_limit = [
            u.name
            for u, value in zip(unknowns, fitted.value, strict=True)
            if u.name in correction and fitted.identifies(u.name) and not u.low < value < u.high
        ]
        if not at_limit:
            return replace(fitted, measured_rms=_measured_rms(windows))
        held += at_limit


def _torque_windows(flight: FlightGrid, drive: str) -> Windows:
    """Return the windows of `flight` for changes of its rates, where all signals are present."""
    form = flight.form(TORQUE_WIDTH_S, ("rate_b", DRIVES[drive][-1]), slope=True)
    measured = np.asarray(TO_RATE_S * (form.change @ np.nan_to_num(flight.signals["rate_b"])))
    no_offset = np.zeros(3, bool)
    return Windows(flight, flight.rows(False), form, measured, no_offset)


def _turning(vehicle: Accelerations, windows: Windows, reliability: np.ndarray) -> np.ndarray:
    """Return the modelled angular acceleration (G, 3), corrected by `_reliability` (3,)."""
    flight = windows.flight
    _, turn_b = vehicle(flight, windows.rows)
    if (reliability == 1.0).all():
        return turn_b
    # Only the part that the rotors cause is noisy.
    still = np.zeros_like(flight.signals["rotor_speed"])
    _, unpowered_b = vehicle(_with_rotor_speed(flight, still), windows.rows)
    return unpowered_b + reliability * (turn_b - unpowered_b)


def _with_rotor_speed(flight: FlightGrid, rotor_speed: np.ndarray) -> FlightGrid:
    """Return `flight` with other rotor speeds (G, 4)."""
    return flight._replace(signals={**flight.signals, "rotor_speed": rotor_speed})


def _reliability(windows: Sequence[Windows], vehicle: Accelerations) -> np.ndarray:
    """Return the share (3,) of the modelled torque's variance that is not rotor-speed noise.

    Further noise of the same size is added to the rotor speeds, to see how much it changes.
    """
    noise_power, power = np.zeros(3), np.zeros(3)
    for flight, rows, form, *_ in windows:
        speed = flight.signals["rotor_speed"]
        noisy = _with_rotor_speed(flight, speed + flight.signals[ROTOR_NOISE])
        turn_b, noisy_turn_b = (form.mean @ vehicle(one, rows)[1] for one in (flight, noisy))
        noise_power += ((noisy_turn_b - turn_b) ** 2).sum(axis=0)
        power += (turn_b**2).sum(axis=0)
    return np.maximum(1.0 - noise_power / np.maximum(power, TINY), TINY)


def _best_correlated_delay(
    residuals: Residuals, numbers: Mapping[str, float], measured: Sequence[np.ndarray]
) -> float:
    """Return the delay `late` [s] at which modelled and measured roll and pitch correlate best."""
    trials = np.array([numbers["late"], *np.arange(0.0, LATEST_S, LATE_STEP_S)])
    scores = np.zeros(len(trials))
    for k, trial in enumerate(trials.tolist()):
        tried = residuals({**numbers, "late": max(trial, 0.0)})
        for rows, turned in zip(tried, measured, strict=True):
            if len(turned):
                # Measured minus residual is the modelled change.
                model, data = (v - np.median(v, axis=0) for v in (turned - rows.value, turned))
                size = np.sqrt((model**2).sum(axis=0) * (data**2).sum(axis=0))
                scores[k] += ((model * data).sum(axis=0) / np.maximum(size, TINY))[:2].sum()
    return float(trials[int(np.argmax(scores))])
