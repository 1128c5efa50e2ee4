"""What moving air turns: the coefficient of blade flapping, by the torque view.

Inertia and lags are told by fast changes alone (`torque.py`), since motors answer what disturbs the
body slowly. What they answer is what flapping is told by, once all else is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.fit.parameters import candidates, make_space
from suite.diagnose.identify.fit import Z95
from suite.diagnose.identify.numbers import Number
from suite.diagnose.views.data.flights import ready
from suite.diagnose.views.data.view import TORQUE
from suite.diagnose.views.fit.equations import ViewTask, half_widths, look
from suite.diagnose.views.fit.model import ForceModel
from suite.diagnose.views.fit.search import ViewSearch, search_view

EFFECT, KEY = "blade_flapping", "coefficient"
UNIT = "N s^2/rad"


def flapping_of(
    logs: Sequence[FlightLog], vehicle: Vehicle, doubted: Sequence[Vehicle] = ()
) -> Number | None:
    """Return the coefficient that `logs` ask for beside all else in `vehicle`, None for no other.

    Whole logs count. It has to pass what a name of a diagnosis has to. `doubted` are vehicles one
    standard deviation off, each in its own way: by what they ask for the interval is wider.
    """
    whole = [log for log in logs if not log.partial]
    try:
        flights = ready(whole, vehicle) if whole else None
    except ValueError:  # nothing drives them, or none has a stretch without a hole
        return None
    if flights is None or TORQUE not in flights.views:
        return None
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in whole)
    task = ViewTask(TORQUE, ForceModel(vehicle, space, voltage), flights.smoothed[TORQUE.name])
    among = [one for one in candidates(space, voltage, ()) if one.name == EFFECT]
    found = search_view(task, among)
    if not found.named:
        return None
    value = float(found.last.theta[found.indices[0]])
    half = float(half_widths(found.last, found.indices)[0])
    moved = [_step(whole, other, found) for other in doubted]
    half = float(np.hypot(half, Z95 * np.linalg.norm(moved)))
    return Number(f"effects.{EFFECT}.{KEY}", UNIT, [value], [(value - half, value + half)])


def _step(logs: Sequence[FlightLog], vehicle: Vehicle, found: ViewSearch) -> float:
    """Return by how much the coefficient of `found` moves where the vehicle is another."""
    space = make_space(vehicle)
    theta = space.array("start")
    theta[found.indices] = found.last.theta[found.indices]
    model = ForceModel(vehicle, space, all(log.voltage is not None for log in logs))
    task = found.task._replace(model=model, flights=ready(logs, vehicle).smoothed[TORQUE.name])
    then, (at,) = look(task, theta, found.last.weights), found.indices
    return float(then.block.gradient[:, at].sum() / then.block.hessian[:, at, at].sum())
