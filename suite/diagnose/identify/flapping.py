"""What moving air turns: the coefficient of blade flapping, by the torque view.

Inertia and lags are told by fast changes alone (`torque.py`), since motors answer what disturbs the
body slowly. What they answer is what flapping is told by, once all else is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.flights import ViewFlights, ready
from suite.diagnose.data.view import TORQUE
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.force_torque import ForceModel
from suite.diagnose.evidence.view_equations import ViewTask, half_widths, look
from suite.diagnose.identify.fit import Z95
from suite.diagnose.identify.numbers import Number
from suite.diagnose.search.view_search import ViewSearch, search_view

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
    voltage = all(log.voltage is not None for log in whole)
    task = _task(flights, vehicle, voltage)
    among = [one for one in candidates(task.model.space, voltage, ()) if one.name == EFFECT]
    found = search_view(task, among)
    if not found.named:
        return None
    value = float(found.last.theta[found.indices[0]])
    half = float(half_widths(found.last, found.indices)[0])
    tasks = (_task(ready(whole, other), other, voltage) for other in doubted)
    moved = [_step(other, found) for other in tasks]
    half = float(np.hypot(half, Z95 * np.linalg.norm(moved)))
    return Number(f"effects.{EFFECT}.{KEY}", UNIT, [value], [(value - half, value + half)])


def _task(flights: ViewFlights, vehicle: Vehicle, voltage: bool) -> ViewTask:
    model = ForceModel(vehicle, make_space(vehicle), voltage)
    return ViewTask(TORQUE, model, flights.smoothed[TORQUE.name])


def _step(task: ViewTask, found: ViewSearch) -> float:
    """Return by how much the coefficient of `found` moves where the vehicle is that of `task`."""
    theta, (at,) = task.model.space.array("start"), found.indices
    theta[at] = found.last.theta[at]
    then = look(task, theta, found.last.weights)
    return float(then.block.gradient[:, at].sum() / then.block.hessian[:, at, at].sum())
