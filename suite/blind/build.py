"""Make one blind case from its description: flights with hidden effects, their logs, the answer.

The answer has the names that a diagnosis must give, and the alternatives: other effects that
explain the flights as well. They come from the oracle (`oracle.py`), which expresses a
difference as a log-likelihood ratio: half the squared change of the flights in standard deviations
of the noise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from itertools import permutations
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.flights.follow import FlightFailed
from eval.flights.simulate import FALL_V_PER_S, SENSORS, Extra, Sensors, fly, log_of
from eval.flights.trajectory import Trajectory, long_flights, ordinary_flights
from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.blind.cases import CONTINUOUS, ROTORPY, Case
from suite.blind.continuous.timing import draw_conditions
from suite.blind.continuous_flight import fly_continuous, logs_of, with_loop_frequency
from suite.blind.oracle import (
    LONG_S,
    REQUIRED,
    THRESHOLD,
    alternatives,
    columns_of,
    detectable,
    information,
    linearised,
    log_ratio,
    nominal_vehicle,
    remaining_ratio,
)
from suite.blind.outside import KINDS, changed_values, draw_change, true_parameters
from suite.blind.rotorpy_flight import fly_rotorpy
from suite.common.errors import WorkFailed
from suite.diagnose.plan import SEPARATIONS

Trajectories = Sequence[Trajectory]
"""Trajectories of a case, one for each flight."""
Random = np.random.Generator
"""Short name of the type."""
LogFlights = Callable[[Random | None], tuple[FlightLog, ...]]
"""Function (random generator of the noise; None: no noise) -> logs of the flights of a case."""
TRIES = 6
"""Number of draws of flights and strengths; if none is valid, the case fails."""


@dataclass(frozen=True)
class Built:
    """The contents of a case."""

    nominal: Vehicle
    """The vehicle file that the diagnosis gets."""
    logs: tuple[FlightLog, ...]
    """The logs of the flights, with noise."""
    answer: dict[str, Any]
    """The answer, which the diagnosis does not get."""


def build(case: Case) -> Built:
    """Make the case; the same description always gives the same bits.

    A draw can fail, such as a flight that crashes. Then the next one is tried.

    Raises:
        WorkFailed: if no draw of flights and strengths gave valid flights.
    """
    reason = ""
    for attempt in range(TRIES):
        try:
            return _attempt(case, np.random.default_rng([*case.seed, attempt]))
        except (FlightFailed, _Unsuitable) as error:
            reason = str(error)
    raise WorkFailed(f"{case.kind} {case.hidden}: no valid flights in {TRIES} draws: {reason}")


class _Unsuitable(Exception):
    """A draw that does not suit the kind of case."""


def _attempt(case: Case, rng: np.random.Generator) -> Built:
    """Make the case with one draw of flights and strengths, from `rng`."""
    trajectories = _trajectories(case, rng)
    simulator = Simulator(case, rng)
    hide = _hide_outside if case.kind == "outside" else _hide_effects
    flown, answer = hide(simulator, trajectories, rng)
    logs = flown(rng)
    if simulator.conditions:
        answer["conditions"] = asdict(simulator.conditions)
    answer["case"] = asdict(case)
    answer["trajectories"] = [asdict(way) for way in trajectories]
    # Without a salt a short answer could be guessed from its hash.
    answer["salt"] = rng.bytes(16).hex()
    return Built(simulator.nominal, logs, answer)


def _trajectories(case: Case, rng: np.random.Generator) -> list[Trajectory]:
    """Return the trajectories of a case; slow effects need long flights."""
    if case.separation >= 0:
        entry = SEPARATIONS[case.separation]
        added = entry.separating if case.kind == "separated" else ()
        return [*entry.blurred, *entry.blurred, *added]
    if case.kind != "outside" and any(EFFECTS[name].slow for name in case.hidden):
        return long_flights(rng)
    return ordinary_flights(rng)


class Simulator:
    """The simulator of one case."""

    def __init__(self, case: Case, rng: np.random.Generator) -> None:
        """Prepare; for the continuous-time engine `rng` draws the conditions of the flights."""
        self.case, self.nominal = case, nominal_vehicle(case.vehicle)
        self.sensors, self.conditions = SENSORS[case.sensors], None
        if case.simulator == CONTINUOUS:
            self.conditions = draw_conditions(rng)
            self.nominal = with_loop_frequency(self.nominal, self.conditions.loop_hz)

    def fly(
        self, truth: Vehicle, trajectories: Trajectories, rng: Random, extra: Extra | None = None
    ) -> LogFlights:
        """Fly with the true vehicle and perhaps additional physics; `rng` draws the gusts.

        MuJoCo and RotorPy advance in steps of the period of the rate loop.
        """
        nominal, sensors, conditions = self.nominal, self.sensors, self.conditions
        if conditions is not None:
            in_time = fly_continuous(nominal, truth, trajectories, conditions, rng, extra)
            return lambda rng: logs_of(in_time, trajectories, truth, sensors, conditions, rng)
        if self.case.simulator == ROTORPY:
            flown = fly_rotorpy(nominal, truth, trajectories, sensors.rate_hz)
        else:
            has_voltage = bool(sensors.voltage)
            flown = fly(nominal, truth, trajectories, sensors.rate_hz, extra, rng, has_voltage)
        return lambda rng: tuple(
            log_of(flight, truth, sensors, rng, f"flight_{index + 1}")
            for index, flight in enumerate(flown)
        )


Hidden = tuple[LogFlights, dict[str, Any]]
"""The function that makes the logs of the flights, and the answer."""


def _hide_effects(simulator: Simulator, trajectories: Trajectories, rng: Random) -> Hidden:
    """Fly with the hidden effects of a case; a null has none."""
    case, nominal, sensors = simulator.case, simulator.nominal, simulator.sensors
    # 1. Draw the hidden effects: change of the parameters, strength, values.
    changes, multiples, effects = {}, {}, {}
    # A blurred and a separated case are twins, so their truth must not depend on the channels.
    table = "capture" if case.separation >= 0 else case.sensors
    for name in case.hidden:
        change, multiple = draw_change(rng, nominal, table, name, case.multiple)
        if case.separation >= 0:
            change, multiple = _blurred_strength(case, nominal, name, change), case.multiple
        changes[name], multiples[name] = change, multiple
        effects[name] = changed_values(nominal, table, name, change, rng)
    has_voltage = bool(sensors.voltage)
    if case.separation >= 0 and has_voltage:
        _depend_on_voltage(nominal, changes, effects)
    # 2. Fly, and compute the names that the flights allow; random effects are not reproducible.
    truth = with_effects(nominal, effects)
    flown = simulator.fly(truth, trajectories, rng)
    steady = {name: change for name, change in changes.items() if not EFFECTS[name].random}
    expected = _expected_names(case, nominal, flown(None), sensors, steady) if steady else {}
    answer = {
        "kind": case.kind,
        "verdict": "named" if case.hidden else "no_gap",
        "effects": [
            {
                "name": name,
                "parameters": true_parameters(name, effects[name], has_voltage),
                "multiple": multiples[name],
                **expected.get(name, {"sigma": None, "required": [], "allowed": []}),
            }
            for name in case.hidden
        ],
    }
    return flown, answer


def _expected_names(
    case: Case,
    nominal: Vehicle,
    logs: Sequence[FlightLog],
    sensors: Sensors,
    changes: dict[str, np.ndarray],
) -> dict[str, dict[str, Any]]:
    """Return for each effect in `changes` its strength and its alternatives.

    The strength is `sigma`, the change of the flights in standard deviations. `required` are the
    alternatives that a diagnosis must name too, `allowed` those that it may name. `left_over` has
    the log-likelihood ratio that remains with each alternative, `left_over_of_long_stretches` the
    same for longer rollouts.

    Raises:
        _Unsuitable: for a pair of effects that are hard to separate.
    """
    info = information(nominal, logs, sensors)
    if case.kind == "pair":
        # One effect must not explain most of the other: they would be hard to separate.
        for name, other in permutations(changes):
            alone = {name: changes[name]}
            if remaining_ratio(info, alone, name, other, nominal) < 2.0 * THRESHOLD:
                raise _Unsuitable(f"{other} explains most of {name}")
    long_info = information(nominal, logs, sensors, horizon_s=LONG_S)
    # Remaining log-likelihood ratios of the alternatives, in short and in long rollouts.
    short, long = (alternatives(each, changes, nominal) for each in (info, long_info))
    return {
        name: {
            "sigma": float(np.sqrt(2.0 * log_ratio(info.block(name), change))),
            "required": [o for o in short[name] if long[name].get(o, np.inf) < REQUIRED],
            "allowed": list(short[name]),
            "left_over": short[name],
            "left_over_of_long_stretches": long[name],
        }
        for name, change in changes.items()
    }


def _depend_on_voltage(
    nominal: Vehicle, changes: dict[str, np.ndarray], effects: dict[str, Any]
) -> None:
    """Make the effects of the battery depend on its voltage instead of time.

    `changes` and `effects` are changed in place. A log with a voltage allows to identify the
    dependence on the voltage.
    """
    for name in effects:
        convert = EFFECTS[name].with_voltage
        if convert is not None:
            effects[name] = convert(effects[name], FALL_V_PER_S)
            nominal_values = all_values(nominal)[name]
            columns = columns_of(True, [name])
            changes[name] = np.array(
                [c.value(effects[name]) - c.value(nominal_values) for c in columns]
            )


def _blurred_strength(case: Case, nominal: Vehicle, name: str, change: np.ndarray) -> np.ndarray:
    """Return `change` scaled to `case.multiple` times the strength detectable on blurred flights.

    Blurred flights are gentle, so they are less informative than the flights of the table of
    strengths. A diagnosis can only name a change that is detectable.
    """
    sensors = SENSORS["capture"]
    trajectories = SEPARATIONS[case.separation].blurred
    flights = fly(nominal, nominal, [*trajectories, *trajectories], sensors.rate_hz)
    logs = [log_of(flight, nominal, sensors, None) for flight in flights]
    info = information(nominal, logs, sensors, [name])
    return case.multiple * detectable(info.block(name), change) * change


def _hide_outside(simulator: Simulator, trajectories: Trajectories, rng: Random) -> Hidden:
    """Fly with physics that no effect describes.

    The strength is `case.multiple` times the strength that is just detectable after a fit of all
    effects of the catalogue. It is computed from a flight at the usual strength.
    """
    case, nominal, sensors = simulator.case, simulator.nominal, simulator.sensors
    name, kind = case.hidden[0], KINDS[case.hidden[0]]

    def fly_at(strength: float) -> tuple[LogFlights, float]:
        """Return flights at a strength, and the log-likelihood ratio that remains after a fit."""
        extra = kind.make(strength, nominal.mass)
        flown = simulator.fly(nominal, trajectories, rng, extra)
        return flown, unexplained_ratio(nominal, flown(None), sensors)

    _, ratio = fly_at(kind.usual)
    # The log-likelihood ratio grows with the square of the strength.
    target = case.multiple * kind.usual * np.sqrt(THRESHOLD / max(ratio, 1e-9))
    strength = float(np.clip(target, 0.2 * kind.usual, kind.most))
    flown, ratio = fly_at(strength)
    answer = {
        "kind": case.kind,
        "verdict": "unknown",
        "effects": [],
        "outside": {
            "name": name,
            "strength": strength,
            "unit": kind.unit,
            "multiple": float(np.sqrt(ratio / THRESHOLD)),
        },
    }
    return flown, answer


def unexplained_ratio(nominal: Vehicle, logs: Sequence[FlightLog], sensors: Sensors) -> float:
    """Return the log-likelihood ratio that remains after a joint fit of all effects."""
    block = linearised(nominal, logs, sensors, columns_of(bool(sensors.voltage)))
    residual, jacobian = block.residual.ravel(), block.slope.reshape(block.residual.size, -1)
    column_norm = np.linalg.norm(jacobian, axis=0)
    jacobian = jacobian[:, column_norm > 0.0] / column_norm[column_norm > 0.0]
    fitted = np.linalg.lstsq(jacobian, residual, rcond=1e-6)[0]
    return float(0.5 * ((residual - jacobian @ fitted) ** 2).sum())
