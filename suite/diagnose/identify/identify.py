"""Estimates the parameters of a vehicle file that flights identify (`suite identify`).

These parameters are called numbers here. There are four fits: force (thrust and drag), torque
(inertia, lag and delay), rotors (lag and delay of measured rotor speeds), and loop (gains of the
rate loop). The lag is the time constant with which the rotors follow their commands.

Force and torque are fitted alternately, each with the result of the other, since the rotors' lag
acts on both. The mass is never fitted: scaling it together with inertia and thrust changes no
flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.inertial import posed
from suite.diagnose.identify.body import (
    FORCE_NUMBERS,
    fit_force,
    fit_torque,
    force_unknowns,
    lag_unknowns,
    torque_unknowns,
)
from suite.diagnose.identify.drive import (
    KNOWN_MOTORS,
    common_drive,
    driven_vehicle,
    with_merged_effects,
    with_motor_map,
)
from suite.diagnose.identify.entries import (
    entries_of,
    with_entries,
    with_reachable_speed,
)
from suite.diagnose.identify.fit import NONE_KNOWN, Fitted, NoWholeWindow, Unknown
from suite.diagnose.identify.flapping import flapping_of, perturbed_vehicles
from suite.diagnose.identify.grid import FlightGrid, grid_of
from suite.diagnose.identify.loop import (
    fit_commanded,
    loop_rates,
    loop_unknowns,
    rotor_speeds,
)
from suite.diagnose.identify.numbers import Number, not_attempted, not_identified, notes_on

PARTS = {
    "drag": ("drag_",),
    "motors": FORCE_NUMBERS,
    "inertia": ("inertia_", "yaw"),
    "lag": ("lag", "late"),
    "loop": ("gain_",),
}
"""Allowed values of `--leave` -> with what the names of their numbers start."""
ROUNDS = 2
"""How often force and torque are fitted."""
NO_LAG_S = 0.004
"""A fitted lag of the rotors below this is rejected if the start has a longer one [s]."""


@dataclass(frozen=True)
class Identified:
    """A vehicle with the numbers that flights identify."""

    vehicle: Vehicle
    """The start vehicle with the identified numbers."""
    numbers: tuple[Number, ...]
    """All numbers that were fitted."""
    not_identified: tuple[str, ...]
    """A line for people for each number that these flights do not identify; it keeps its start."""
    drive: str
    """Drive of the flights: pwm, rotors, torques, rates or thrust."""
    residual_rms: dict[str, list[float]]
    """RMS of the residual along each body axis, by fit: `force` (per mass) and `torque`."""
    flights: tuple[str, ...]
    """Names of the flights that were used."""
    notes: tuple[str, ...] = ()
    """Lines for people on what was done with flights and vehicle beyond the fitted numbers."""


def identify(logs: Sequence[FlightLog], vehicle: Vehicle, leave: Sequence[str] = ()) -> Identified:
    """Estimate the numbers of `vehicle` that `logs` identify.

    Args:
        logs: flights of one vehicle; incomplete ones are used for the numbers that they allow.
        vehicle: vehicle from which the fits start; a number that is not identifiable keeps its
            value.
        leave: parts not to fit: any of drag, motors, inertia, lag, loop.

    Returns:
        The vehicle with the identified numbers, and their intervals.

    Raises:
        ValueError: if no signal drives the model in all flights, or no fit has a complete window.
    """
    # Run the fits. If the motors' thrust is known, the loop comes last and may use the lag of the
    # torque fit, which is better than its own. Otherwise it comes first: the others use its lag.
    flights = [grid_of(log) for log in posed(logs)]
    drive = common_drive(flights)
    fits = _Fits(flights, with_merged_effects(vehicle, drive in KNOWN_MOTORS), drive, tuple(leave))
    if drive not in KNOWN_MOTORS:
        fits.fit_loop()
    for _ in range(ROUNDS):
        fits.fit_force()
        fits.fit_torque()
    if drive in KNOWN_MOTORS:
        fits.fit_loop()
    if not fits.results:
        names = ", ".join(flight.name for flight in flights)
        if not leave:
            raise ValueError(
                f"{names}: no stretch of a second with positions or body rates and the signals "
                "that drive the motors; import these flights again and read the report"
            )
        lacking = "; ".join(fits.lacking()) or "no stretch of a second with the needed signals"
        raise ValueError(f"{names}: without {', '.join(leave)} nothing is identifiable: {lacking}")
    identified = fits.identified(vehicle)
    # Blade flapping needs the results of both fits, and motors whose thrust is known.
    if drive not in KNOWN_MOTORS or "drag" in leave or not {"force", "torque"} <= {*fits.results}:
        return identified
    force, torque = fits.results["force"], fits.results["torque"]
    perturbed = perturbed_vehicles(identified.vehicle, fits.driven, force, torque)
    with_voltage = [log for log in logs if log.name not in fits.without_voltage]
    entry = flapping_of(with_voltage, identified.vehicle, perturbed)
    if entry is None:
        return identified
    with_flapping, numbers, notes = with_entries(identified.vehicle, [entry])
    return replace(
        identified,
        vehicle=with_flapping,
        numbers=(*identified.numbers, *numbers),
        notes=(*identified.notes, *notes),
    )


class _Fits:
    """The fits of one identification; each starts from the results of those before it."""

    def __init__(
        self, flights: list[FlightGrid], vehicle: Vehicle, drive: str, leave: tuple[str, ...]
    ) -> None:
        self.flights, self.start, self.drive, self.leave = flights, vehicle, drive, leave
        if drive == "pwm" and (vehicle.motors is None or "motors" not in leave):
            self.start = with_motor_map(flights, vehicle)
        self.driven = driven_vehicle(flights, self.start, drive)
        self.results: dict[str, Fitted] = {}
        """Results by the name of the fit: force, torque, rotors or loop."""
        self.broken: set[str] = set()
        """Names of fits without a complete window."""
        self.without_voltage: set[str] = set()
        """Names of flights without a voltage, if others have one."""
        lag_s: float = vehicle.rotors.time_constant
        delay, scale = (vehicle.effects.get(name) for name in ("command_delay", "thrust_scale"))
        self.log_thrust = 0.0 if scale is None else float(np.log(scale.scale))
        """Logarithm of the thrust's scale at the start."""
        self.numbers = {
            "thrust": self.log_thrust,
            "lag": lag_s,
            "late": lag_s + (0.0 if delay is None else delay.delay),
        }
        """Present values of the numbers on which several fits depend, by name."""

    def fit_force(self) -> None:
        """Fit thrust and drag to the translation."""
        flights = [flight for flight in self.flights if flight.has("vel_w")]
        # If no flight has an attitude, it follows from how the vehicle must lean to fly its path.
        leaning = not any(flight.has("rot_w") for flight in flights)
        flights = [flight for flight in flights if leaning or flight.has("rot_w")]
        if not flights:
            return
        flights = self.with_known_thrust(flights)
        voltage = all(flight.has("voltage") for flight in flights)
        unknowns = self.wanted(force_unknowns(self.driven, voltage, leaning, self.log_thrust))
        if unknowns:
            fixed = {**self.numbers, "thrust": self.log_thrust}
            self.attempt("force", fit_force, unknowns, flights, self.driven, fixed)

    def fit_torque(self) -> None:
        """Fit inertia, yaw torque, lag and delay to the rotation."""
        flights = [flight for flight in self.flights if flight.has("rate_b")]
        if self.drive in ("rates", "thrust") or not flights:  # these commands contain no torques
            return
        starts = torque_unknowns(self.drive, self.numbers["lag"], self.numbers["late"])
        unknowns = self.wanted(starts)
        if not unknowns:
            return
        flights = self.with_known_thrust(flights)
        fixed, known = dict(self.numbers), NONE_KNOWN
        if "force" in self.results and self.drive in KNOWN_MOTORS:
            fixed |= self.results["force"].values()
            known = self.results["force"].known_numbers(*FORCE_NUMBERS)
        inputs = (flights, self.driven, fixed, known)
        result = self.attempt("torque", fit_torque, unknowns, *inputs)
        start_lag_s = self.start.rotors.time_constant
        if result and result.identifies("lag") and result.values()["lag"] < NO_LAG_S < start_lag_s:
            # No rotor follows at once. Commands that are blurred in the log hide its lag, so the
            # start's lag is held and the other numbers are fitted again.
            unknowns = [u._replace(start=start_lag_s) if u.name == "lag" else u for u in unknowns]
            self.attempt("torque", fit_torque, unknowns, *inputs, ("lag",))

    def fit_loop(self) -> None:
        """Fit the rotors' lag behind commanded speeds, and the nominal rate loop."""
        speeds = ("rotor_speed", "rotor_speed_cmd")
        # Speeds of motors that are read one after another are blurred, which resembles a lag.
        commanded = [f for f in self.flights if f.has(*speeds) and not {*speeds} & {*f.in_turn}]
        if commanded and "lag" not in self.leave:
            starts = lag_unknowns(self.numbers["lag"], self.numbers["late"])
            inputs = (commanded, "rotor_speed", rotor_speeds, starts, self.numbers)
            self.attempt("rotors", fit_commanded, *inputs)
        flights = [f for f in self.flights if f.has("rate_b", "rate_cmd_b")]
        if not flights or self.start.controller.kind != "p" or "loop" in self.leave:
            return
        # If the motors are known, other fits identify lag and delay better: hold them fixed here.
        lags, known = lag_unknowns(self.numbers["lag"], self.numbers["late"]), NONE_KNOWN
        if "rotors" in self.results or self.drive == "pwm" or "lag" in self.leave:
            source = self.results.get("rotors", self.results.get("torque"))
            known = source.known_numbers("late", "lag") if source else NONE_KNOWN
            lags = [u for u in lags if u.name in known.names]
        unknowns = [*loop_unknowns(self.start, flights), *lags]
        model = partial(loop_rates, self.start)
        self.attempt("loop", fit_commanded, flights, "rate_b", model, unknowns, self.numbers, known)

    def wanted(self, unknowns: Sequence[Unknown]) -> list[Unknown]:
        """Return `unknowns` without the parts that the user chose not to fit."""
        not_wanted = tuple(prefix for part in self.leave for prefix in PARTS[part])
        return [u for u in unknowns if not u.name.startswith(not_wanted)]

    def with_known_thrust(self, flights: list[FlightGrid]) -> list[FlightGrid]:
        """Return the flights in which the motors' thrust is known best, and remember the others.

        The thrust of a motor command depends on the battery. For this drive, flights without a
        voltage are therefore left out if other flights have one.
        """
        with_voltage = [flight for flight in flights if flight.has("voltage")]
        if self.drive != "pwm" or not with_voltage:
            return flights
        self.without_voltage |= {flight.name for flight in flights if not flight.has("voltage")}
        return with_voltage

    def attempt(self, name: str, fit: Callable[..., Fitted], *inputs: Any) -> Fitted | None:
        """Run `fit` on `inputs`, and keep its result for the following fits and under its name.

        Without a complete window there is none, and the name is added to `broken`.
        """
        try:
            result = fit(*inputs)
        except NoWholeWindow:
            self.broken.add(name)
            return None
        self.results[name] = result
        values = result.values()
        self.numbers |= {number: values[number] for number in self.numbers if number in values}
        return result

    def lacking(self) -> list[str]:
        """Return a line for people for each number that was not fitted."""
        return not_attempted(
            self.flights, self.start, self.drive, self.results, self.leave, self.broken
        )

    def identified(self, original: Vehicle) -> Identified:
        """Return the result of all fits; `original` is the vehicle before any change."""
        results, by_key = self.results, dict[str, Number]()
        # Several fits may estimate lag and delay. Later fits in this order observe them more
        # directly.
        for name in ("force", "torque", "rotors", "loop"):
            if name not in results:
                continue
            for entry in entries_of(self.driven, results[name], self.numbers["thrust"]):
                if entry.key not in by_key or entry.is_identified:
                    by_key[entry.key] = entry
        vehicle, numbers, notes = with_entries(self.start, by_key.values())
        if self.drive == "rotors":
            speeds = [f.signals["rotor_speed"] for f in self.flights]
            vehicle = with_reachable_speed(vehicle, speeds)
        return Identified(
            vehicle,
            tuple(numbers),
            (*not_identified(results, by_key), *self.lacking()),
            self.drive,
            {
                name: results[name].residual_rms.tolist()
                for name in ("force", "torque")
                if name in results
            },
            tuple(flight.name for flight in self.flights),
            (*notes_on(self.flights, self.without_voltage, original, vehicle), *notes),
        )
