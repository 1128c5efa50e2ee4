"""Check the order and the unit of Euler angles against the gyro, before they become quaternions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations

import numpy as np

from eval.importers.rows import measured
from eval.importers.signals import Signal
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import BAD, CALM_RATE, TIMES_BETTER, WIDTH_S, turns_of
from eval.logs.faults.relation import match, rms, smooth
from eval.logs.faults.vectors import DEG, GOOD

ANGLES = ("roll", "pitch", "yaw")
"""The order in which angles are read."""
UNITS = {
    1.0 / DEG: ("rad, read as deg", (0.0, 1.05 * np.pi * DEG)),
    DEG: ("deg, read as rad", (2.1 * np.pi, np.inf)),
}
"""Factor that corrects the angles -> their unit in words, and the range of the largest angle as
read [rad]. Within it the gyro's unit is less likely to be wrong than that of the angles."""


def check_angles(
    angles: Signal, quat_of: Callable[[np.ndarray], np.ndarray], rate: Signal, fix_order: bool
) -> tuple[np.ndarray | None, list[Finding]]:
    """Return corrected angles (N, 3) [rad], None where the given ones are kept, and the finding.

    Another order must explain its rates better than other axes of the gyro do. Another unit is only
    reported, since small angles in a wrong unit look like a gyro in a wrong unit.

    Args:
        angles: roll, pitch and yaw as read from the file [rad].
        quat_of: converts angles to quaternions wxyz (N, 4) in the log's frames.
        rate: body rates of the gyro [rad/s].
        fix_order: correct the order; False: only report it.
    """
    time_s, value = angles
    if len(time_s) < 4:
        return None, []
    gyro = smooth(time_s, measured(rate, time_s, smooth=False), WIDTH_S)
    size = max(rms(gyro), CALM_RATE)

    def turns(value: np.ndarray) -> np.ndarray:
        return smooth(time_s, turns_of(time_s, quat_of(value)), WIDTH_S)

    as_given = turns(value)
    given = rms(as_given - gyro) / size
    if not given > BAD:
        return None, []
    largest = float(np.nanmax(np.abs(value)))
    units = [f for f, (_, (low, high)) in UNITS.items() if low < largest < high]
    tried = {
        **{(order, 1.0): value[:, order] for order in permutations(range(3))},
        **{((0, 1, 2), factor): factor * value for factor in units},
    }
    misfit = {key: rms(turns(angles) - gyro) / size for key, angles in tried.items()}
    order, factor = min(misfit, key=lambda key: misfit[key])
    best = misfit[order, factor]
    if factor == 1.0:  # other axes of the gyro may explain as much
        alike = np.clip(match(as_given, gyro).alike.min(), 0.0, 1.0)
        given = min(given, float(np.sqrt(1.0 - alike**2)))
    if best > GOOD or best * TIMES_BETTER > given:
        return None, []
    text = f"its turns are off the gyro's by {100 * given:.0f} %, but by {100 * best:.0f} % if the "
    if factor != 1.0:
        text += f"angles are in {UNITS[factor][0]}"
        fix = "unit of [euler] in the mapping file, or the gyro's unit"
        return None, [Finding("doubt", "attitude", text, "attitude", None, 0.95, fix)]
    text += f"columns are {', '.join(ANGLES[order.index(k)] for k in range(3))}"
    about = ("attitude", None, 0.98, "columns of [euler] in the mapping file")
    status = "corrected" if fix_order else "doubt"
    return (value[:, order] if fix_order else None), [Finding(status, "attitude", text, *about)]
