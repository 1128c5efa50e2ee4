"""Whether a name holds for slow and for fast changes alike.

Motors answer what disturbs the body. A controller that holds it still against a slow torque makes
the motors' torque look like one that turns nothing, as if inertia were larger or thrust less.
Where the equations are right, what changes from one moment to the next asks for the same numbers as
the whole does (a specification test; Hausman 1978, doi 10.2307/1913827).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from suite.diagnose.estimate.intervals import half_widths95
from suite.diagnose.evidence.moments import ViewData
from suite.diagnose.evidence.view_equations import ViewEquations, ViewTask
from suite.diagnose.evidence.weigh import blocks_of, equations_of, weights_of
from suite.diagnose.thresholds import Thresholds


def changes_of(data: ViewData) -> ViewData:
    """Return what changes in `data` from each moment to the next one of its flight."""
    step = np.diff(data.middle_s)
    usual = np.median(step[step > 0.0])
    near = (np.diff(data.flight) == 0) & (step < 1.5 * usual)
    flight, middle_s, *series = data
    return ViewData(
        flight[1:][near], middle_s[1:][near], *(np.diff(one, axis=0)[near] for one in series)
    )


def fast_share(
    data: ViewData, indices: Sequence[int], away: np.ndarray, limits: Thresholds
) -> tuple[float, float]:
    """Return which share of a name's numbers fast changes ask for, and how surely.

    Args:
        data: with the name in the model.
        indices: its K numbers.
        away: (K,) how far they are from the vehicle file's.
        limits: of independent stretches.

    Returns:
        1 where fast changes ask for the same, 0 where they ask for none of it, to first order; and
        half of its 95 % interval.
    """
    fast = changes_of(data)
    fast = fast._replace(slope=(fast.slope[..., list(indices)] @ away)[..., None])
    blocks = equations_of(fast, weights_of(fast, limits), blocks_of(fast, limits))
    power = max(float(blocks.hessian.sum()), 1e-300)
    return 1.0 + float(blocks.gradient.sum()) / power, float(half_widths95(blocks)[0])


def holds_at_any_speed(task: ViewTask, found: ViewEquations, indices: Sequence[int]) -> bool:
    """Return whether fast changes do not speak against the numbers at `indices`, fitted in `found`.

    They do where they ask for less than a share of them, and surely for less than all. Means of
    flights have no changes.
    """
    if task.means:
        return True
    at = list(indices)
    away = found.theta[at] - task.model.space.array("start")[at]
    share, half_width = fast_share(found.data, at, away, task.limits)
    return share >= task.limits.least_fast_share or share + half_width >= 1.0
