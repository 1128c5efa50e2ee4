"""Errors of rollouts by their inputs: steps, rotor speeds and commands that no log contains.

If the drone received commands between the rows of the log, these are taken as the mean of their
neighbours. The true ones gave another thrust and torque. How large they are is estimated by a
comparison with commands that differ from the mean by chance. Thrust and torque at the knots of a
window become nuisance parameters of this size, and what changes faster than the knots counts as
noise. Commands at uncertain times (jitter) have such an error, too; there the comparison is with
commands whose times are shifted by chance.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from suite.diagnose.data.noise import Linearisation, Noise, measured_noise
from suite.diagnose.data.sampling import interpolate
from suite.diagnose.data.whitening import Whitening, block_of, make_whitening, project_out
from suite.diagnose.data.windows import KNOTS, SLICES, FlightWindows
from suite.diagnose.estimate.block import Estimate
from suite.diagnose.evidence.rollouts import RolloutModel
from suite.diagnose.thresholds import Thresholds

FINE_KNOTS = 26
"""Number of knots of a window for the error of unknown commands, 0.04 s apart: these change with
each decision. Errors that last for less than the time between knots act as one that lasts so long;
with fewer knots they would count as noise that is independent from row to row."""
BETWEEN = 2.0 / 3.0
"""Variance of an unknown command about its best estimate by the logged ones, relative to that of a
logged command about the mean of its neighbours: 2/3 if commands are independent, 1/2 if they are a
random walk, and less if they are smooth."""
REACTION = 0.3
"""Standard deviation of how much an unknown rate command depends on the measured rate."""
WIDE = 100.0
"""Standard deviation of an unknown thrust [m/s^2] and torque [rad/s^2] that data determine."""
FORCE, COMMANDED = slice(0, 3), slice(2, 6)
"""Axes of a push: those of a force, and those of the thrust and torque by commands."""
LEAST_PUSH = 1e-3
"""Lower limit of the error of thrust [m/s^2] and torque [rad/s^2]."""


def residual_change(model: RolloutModel, linear: Linearisation, other: FlightWindows) -> np.ndarray:
    """Return the residuals (W, N, 19) of windows with `other` inputs, minus those of `linear`."""
    at = Estimate(model.space.array("start"), linear.offset)
    return model.residual(at, other) - linear.residual


def with_model_error(
    linear: Linearisation, difference: np.ndarray, limits: Thresholds
) -> Thresholds:
    """Return `limits` with the lower limits of the noise raised to the model's numerical error.

    It is estimated by step doubling (Hairer, Norsett & Wanner 1993, Sec. II.4): longer steps and
    fewer rotor speeds change the residuals by the `difference` (W, N, 19), several times the error.
    `linear` has slopes along all parameters and start numbers.
    """
    noise = measured_noise(linear, limits)
    whitening = make_whitening(linear, noise, limits)
    return _raised(_unexplained_rms(difference, linear, noise, whitening), limits)


class Share(NamedTuple):
    """Estimated share of commands between the rows of logs."""

    value: float
    error: float
    """Standard error of `value`, which includes the misfit."""

    def are_lacking(self, limits: Thresholds) -> bool:
        """Return whether logs certainly lack commands."""
        return self.value - 3.0 * self.error > limits.lacking_share

    def are_complete(self, limits: Thresholds) -> bool:
        """Return whether logs certainly have every command."""
        return self.value + 3.0 * self.error <= limits.held_share


def share_between(
    linear: Linearisation, difference: np.ndarray, push: np.ndarray, limits: Thresholds
) -> Share:
    """Return the share of commands between the rows.

    The share is 0 if each command holds until the next row, and 1 if the mean of two commands acts
    half-way, as it does on average if the drone received others in between. This changes the
    residuals by the `difference` (W, N, 19). The share is fitted together with all parameters,
    since a delay or a shifted clock moves commands in time as well; and with a force and a torque
    of any course over the knots, since commands in between differ from the mean, and something may
    act that no parameter describes. If the share is uncertain then, the torque is left out.
    `linear` has slopes along all parameters and start numbers; for `push` see `push_slopes`.
    """
    noise = measured_noise(linear, limits)
    toward = -_zeroed(difference)[0][..., None]
    # Along all parameters and the share; slopes along start numbers are not needed any more.
    slope = np.concatenate([toward, linear.slope[..., : -linear.offset.shape[1]]], axis=-1)
    share = _share(linear, slope, push, noise, limits)
    if 3.0 * share.error > limits.held_share:
        share = _share(linear, slope, push[..., FORCE], noise, limits)
    return share


def _share(
    linear: Linearisation, slope: np.ndarray, push: np.ndarray, noise: Noise, limits: Thresholds
) -> Share:
    """Return the share; `slope` (W, N, 19, 1 + K) is along it and K parameters."""
    linear = linear._replace(windows=with_input_error(linear.windows, push, WIDE))
    whitening = make_whitening(linear, noise, limits)
    rows, _ = project_out(whitening, linear._replace(slope=slope), slope.shape[-1])
    rows = rows.reshape(-1, rows.shape[-1])
    rows = rows[:, np.r_[True, True, (rows[:, 2:] ** 2).sum(axis=0) > 0.0]]
    size = np.linalg.norm(rows[:, 1:], axis=0)
    slope, residual = rows[:, 1:] / size, rows[:, 0]
    inverse = np.linalg.pinv(slope.T @ slope, rcond=1e-9, hermitian=True)
    best = inverse @ (slope.T @ residual)
    # What remains may be more than noise.
    free = linear.offset.size + push[:, 0, 0].size + len(best)
    freedom = int(np.asarray(linear.windows.valid).sum()) - free
    chi2 = float(((residual - slope @ best) ** 2).sum())
    scale = np.sqrt(max(chi2 / max(freedom, 1), 1.0))
    error = scale * np.sqrt(inverse[0, 0]) / size[0]
    return Share(float(best[0] / size[0]), float(error))


def push_slopes(model: RolloutModel, linear: Linearisation, knots: int = KNOTS) -> np.ndarray:
    """Return slopes (W, N, 19, K, 6) along a push at a knot: force [m/s^2], torque [rad/s^2].

    `FORCE` and `COMMANDED` are parts of its axes.
    """
    at = Estimate(model.space.array("start"), linear.offset)
    slope = model.respond(at, linear.windows, knots)[0].slope
    return slope.reshape(*slope.shape[:3], knots, 6)


def with_input_error(
    windows: FlightWindows, push: np.ndarray, error: np.ndarray | float
) -> FlightWindows:
    """Return `windows` with further errors of the input, of the size `error` (W, K), (K,) or ().

    For `push` (W, N, 19, KNOTS, K) see above.
    """
    count, *_, width = push.shape
    columns = push * np.broadcast_to(error, (count, width))[:, None, None, None]
    columns = columns.reshape(*push.shape[:3], -1)
    if windows.input_error is not None:
        columns = np.concatenate([windows.input_error, columns], axis=-1)
    return windows._replace(input_error=columns)


def with_mean_errors(model: RolloutModel, linear: Linearisation) -> FlightWindows:
    """Return the windows of `linear` with systematic errors of the mean of two commands.

    Commands follow the flight, so that one in between may be nearer to the command before it than
    to the next. A part of each command may be noise, so that the mean of more commands is nearer.
    And a policy reacts to the flight in between, which looks like another gain of the rate loop.
    One standard deviation of these errors, for thrust and each rate, is the difference of the mean
    from the command before alone, that from the mean of the next but one on both sides, and
    `REACTION`.
    """
    windows = linear.windows
    known, bend = _known(windows)
    other = (bend[:, :-1] + bend[:, 1:], 0.5 * np.diff(known, axis=1))
    changes = [-change * channel for change in other for channel in np.eye(4)]
    changes += [-REACTION * _rates_between(windows) * channel for channel in np.eye(4)[1:]]
    columns = [
        _zeroed(residual_change(model, linear, _with_between(windows, change)))[0]
        for change in changes
    ]
    return with_input_error(windows, np.stack(columns, axis=-1)[..., None, :], 1.0)


def as_likely(windows: FlightWindows) -> FlightWindows:
    """Return `windows` with commands between the rows that are as likely as the mean of two.

    They differ from the mean by chance, as much as `BETWEEN` says.
    """
    known, bend = _known(windows)
    size = np.sqrt(BETWEEN * 0.5 * (bend[:, :-1] ** 2 + bend[:, 1:] ** 2))
    return _with_between(windows, size * np.random.default_rng(0).choice((-1.0, 1.0), size.shape))


def _known(windows: FlightWindows) -> tuple[np.ndarray, np.ndarray]:
    """Return the logged commands (W, C, 4), and how far each is from the mean of its neighbours."""
    known = np.asarray(windows.command)[:, ::2]
    bend = known[:, 1:-1] - 0.5 * (known[:, :-2] + known[:, 2:])
    return known, np.pad(bend, ((0, 0), (1, 1), (0, 0)), mode="edge")


def _rates_between(windows: FlightWindows) -> np.ndarray:
    """Return the measured rates at the commands between the rows (W, C, 4); the thrust is 0."""
    between_s = np.asarray(windows.command_s)[:, 1:-1:2]
    between_s = np.where(np.isfinite(between_s), between_s, 0.0)
    measured = np.asarray(windows.valid)[..., SLICES["rates"]]
    rate_b = np.where(measured, windows.row.rate_b, np.nan)
    rates = map(interpolate, between_s, np.asarray(windows.row_s), rate_b)
    return np.pad(np.stack([*rates]), ((0, 0), (0, 0), (1, 0)))


def _with_between(windows: FlightWindows, change: np.ndarray) -> FlightWindows:
    """Return `windows` with the commands between the rows changed by `change` (W, C, 4)."""
    command_s, command = (np.array(x) for x in (windows.command_s, windows.command))
    added = np.zeros_like(command)
    added[:, 1 : 2 * change.shape[1] : 2] = change
    # The place after a command, those that pad the windows, and two before, have no neighbours.
    is_real = np.isfinite(command_s)
    added[np.arange(command.shape[1]) >= is_real.sum(axis=1, keepdims=True) - 3] = 0.0
    length_s = np.diff(np.where(is_real, command_s, 0.0))[..., None]
    total = np.cumsum(length_s * added[:, :-1], axis=1)
    command_sum = np.array(windows.command_sum)
    command_sum[:, 1:] += total
    return windows._replace(command=command + added, command_sum=command_sum)


def unknown_commands(
    linear: Linearisation, push: np.ndarray, difference: np.ndarray, limits: Thresholds
) -> tuple[np.ndarray, Thresholds]:
    """Return the error (W, 4) of thrust and torque by unknown commands, and limits with its noise.

    Other commands, which are as likely, change the residuals by the `difference` (W, N, 19). For
    `push` see `push_slopes`; its axes are `COMMANDED`.
    """
    noise = measured_noise(linear, limits)
    difference, _ = _zeroed(difference)
    linear = linear._replace(residual=difference)

    def with_error(error: np.ndarray | float) -> tuple[Linearisation, Whitening]:
        wide = linear._replace(windows=with_input_error(linear.windows, push, error))
        return wide, make_whitening(wide, noise, limits)

    wide, whitening = with_error(WIDE)
    _, change = project_out(whitening, wide)
    knots = push.shape[3]
    values = WIDE * change[:, -knots * 4 :, 0].reshape(-1, knots, 4)
    power = (values**2).mean(axis=1)
    # A window's own error counts as much as that of all windows.
    error = np.maximum(np.sqrt(0.5 * (power + power.mean(axis=0))), LEAST_PUSH)
    known, whitening = with_error(error)
    return error, _raised(_unexplained_rms(difference, known, noise, whitening), limits)


def _unexplained_rms(
    errors: np.ndarray, linear: Linearisation, noise: Noise, whitening: Whitening
) -> np.ndarray:
    """Return the RMS (6,) by sensor (of `SLICES`) of the part that no start state explains.

    `errors` are (W, N, 19); windows that diverge are left out. It is 0 where nothing was measured.
    """
    errors, known = _zeroed(errors)
    unexplained = block_of(whitening, linear._replace(residual=errors), ()).residual
    _, rows, channels = errors.shape
    over_noise = unexplained[:, : rows * channels].reshape(errors.shape)
    sigma = np.where(np.isfinite(noise.sigma), noise.sigma, 0.0)
    valid = np.asarray(linear.windows.valid) & known
    energy = (np.where(valid, over_noise * sigma, 0.0) ** 2).sum(axis=(0, 1))
    # Mean of each channel, and then of each group of channels (three or four of one sensor).
    power = energy / np.maximum(valid.sum(axis=(0, 1)), 1)
    return np.array([np.sqrt(power[channel].mean()) for channel in SLICES.values()])


def _zeroed(errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return `errors` (W, N, 19), 0 in windows that diverge, and which (W, 1, 1) do not."""
    known = np.asarray(np.isfinite(errors).all(axis=(1, 2), keepdims=True))
    return np.where(known, errors, 0.0), known


def _raised(error: np.ndarray, limits: Thresholds) -> Thresholds:
    """Return `limits` with lower limits of the noise of at least `error` (6,)."""
    return replace(limits, least_noise=tuple(np.maximum(limits.least_noise, error).tolist()))
