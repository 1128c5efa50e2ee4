"""What drives the model: the recorded commands, or the measured rotor speeds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.flight_log import FlightLog
from suite.diagnose.evidence import make_frame
from suite.diagnose.model import Model
from suite.diagnose.noise import noise_of
from suite.diagnose.windows import SLICES, Windows

FOLLOWS = 0.5
"""Rotor speeds that the nominal rate loop predicts worse than this share of how they change are
another controller's: they are the input then."""
SEEN = 2.0
"""Below this multiple of its noise the difference says nothing."""
DEGREE = 5
"""Of the polynomials in which rotor speeds are compared."""


def choose_drive(logs: Sequence[FlightLog], drive: str) -> bool:
    """Return whether measured rotor speeds drive the model, as far as the columns decide.

    Raises:
        ValueError: for an unknown `drive`, or one that the logs do not allow.
    """
    commands = all(log.thrust_cmd is not None for log in logs)
    motors = all(log.rotor_speed is not None for log in logs)
    if drive not in ("auto", "commands", "motors"):
        raise ValueError(f"drive = {drive!r}; allowed: auto, commands, motors")
    if not commands and not motors:
        raise ValueError("some flights have commands only and some rotor speeds only: sort them")
    if (drive == "commands" and not commands) or (drive == "motors" and not motors):
        raise ValueError(f"drive = {drive!r}, but not every flight has them")
    return drive == "motors" or not commands


def another_controller(model: Model, windows: Windows) -> bool:
    """Return whether the measured rotor speeds are not those that the nominal rate loop asks for.

    Slow changes are compared, where neither the gyro's noise in the loop nor that of the speeds
    counts for much.
    """
    rotors = SLICES["rotor speed"]
    seen = np.asarray(windows.seen)[..., rotors]
    if not seen.any():
        return False
    theta = model.space.array("start")
    offset = np.zeros((len(windows.flight), model.free))
    linear = model.linearise(theta, offset, windows, model.starts)
    sigma = noise_of(linear.residual, windows)
    frame = make_frame(linear, sigma, windows)
    white = np.where(windows.seen, linear.residual / np.where(np.isfinite(sigma), sigma, 1.0), 0.0)
    flat = white.reshape(len(white), -1, 1)
    freed = flat - frame.start @ (np.swapaxes(frame.start, 1, 2) @ flat)
    apart = freed.reshape(white.shape)[..., rotors]
    turned = np.where(seen, np.asarray(windows.row_rotor_speed) / sigma[rotors], 0.0)
    error, change, freedom = 0.0, 0.0, 0
    for w in range(len(white)):
        rows = seen[w].all(axis=-1)
        time = np.asarray(windows.row_s)[w, rows]
        if len(time) <= DEGREE + 1:
            continue
        basis = np.linalg.qr(np.vander(2.0 * time - 1.0, DEGREE + 1)[:, ::-1])[0]
        error += float(((basis.T @ apart[w, rows]) ** 2).sum())
        change += float(((basis[:, 1:].T @ turned[w, rows]) ** 2).sum())
        freedom += 4 * (DEGREE + 1)
    return error > SEEN**2 * freedom and error > FOLLOWS**2 * change
