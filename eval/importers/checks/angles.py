"""Check the order and the unit of Euler angles against the gyro, before they become quaternions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import permutations, product

import numpy as np

from eval.importers.rows import measured
from eval.importers.signals import Signal
from eval.logs.faults.finding import Finding
from eval.logs.faults.pose import BAD, CALM_RATE, TIMES_BETTER, WIDTH_S, turns_of
from eval.logs.faults.relation import match, rms, smooth
from eval.logs.faults.vectors import DEG, GOOD

ANGLES = ("roll", "pitch", "yaw")
"""The order in which angles are read."""
UNITS = {1.0: "", 1.0 / DEG: "rad, read as deg", DEG: "deg, read as rad"}
"""Factor that corrects the angles -> their unit in words."""


def check_angles(
    angles: Signal, quat_of: Callable[[np.ndarray], np.ndarray], rate: Signal, fix: bool
) -> tuple[np.ndarray | None, list[Finding]]:
    """Return corrected angles (N, 3) [rad], None where the given ones are kept, and the finding.

    Another order must explain its rates better than other axes of the gyro do.

    Args:
        angles: roll, pitch and yaw as read from the file [rad].
        quat_of: converts angles to quaternions wxyz (N, 4) in the log's frames.
        rate: body rates of the gyro [rad/s].
        fix: correct the angles; False: only report a fault.
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
    tried = {
        (order, factor): rms(turns(factor * value[:, order]) - gyro) / size
        for order, factor in product(permutations(range(3)), UNITS)
    }
    order, factor = min(tried, key=lambda key: tried[key])
    best = tried[order, factor]
    if factor == 1.0:  # other axes of the gyro may explain as much
        alike = np.clip(match(as_given, gyro).alike.min(), 0.0, 1.0)
        given = min(given, float(np.sqrt(1.0 - alike**2)))
    if best > GOOD or best * TIMES_BETTER > given:
        return None, []
    are = [f"the columns are {', '.join(ANGLES[order.index(k)] for k in range(3))}"]
    are = [] if order == (0, 1, 2) else are
    are += [f"the angles are in {UNITS[factor]}"] if factor != 1.0 else []
    text = f"its turns are off the gyro's by {100 * given:.0f} %, but by {100 * best:.0f} % if "
    about = ("attitude", None, 0.98, "columns or unit of [euler] in the mapping file")
    finding = Finding("corrected" if fix else "doubt", "attitude", text + " and ".join(are), *about)
    return (factor * value[:, order] if fix else None), [finding]
