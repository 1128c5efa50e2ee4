"""Estimates the parameters of a vehicle file that flights identify (`suite identify`).

These parameters are called numbers here. There are four fits: force (thrust and drag), torque
(inertia, lag and delay), rotors (lag and delay of measured rotor speeds), and loop (gains of the
rate loop). Force and torque are fitted alternately, each with the result of the other, since the
rotors' lag acts on both. The mass is never fitted: scaling it together with inertia and thrust
changes no flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from eval.effects import all_values
from eval.effects.log_faults import true_log
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
    DRIVES,
    KNOWN_MOTORS,
    common_drive,
    driven_vehicle,
    with_merged_effects,
)
from suite.diagnose.identify.entries import entries_of, with_entries, with_reachable_speed
from suite.diagnose.identify.fit import NONE_KNOWN, Fitted, NoWholeWindow, Unknown
from suite.diagnose.identify.flapping import flapping_of, perturbed_vehicles
from suite.diagnose.identify.grid import FlightGrid, grid_of, with_ground
from suite.diagnose.identify.loop import fit_commanded, loop_rates, loop_unknowns, rotor_speeds
from suite.diagnose.identify.numbers import (
    Number,
    misfit_notes,
    not_attempted,
    not_identified,
    notes_on,
)

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
    notes: tuple[str, ...] = ()
    """Lines for people on what was done with flights and vehicle beyond the fitted numbers."""


def identify(logs: Sequence[FlightLog], vehicle: Vehicle, leave: Sequence[str] = ()) -> Identified:
    """Estimate the numbers of `vehicle` that `logs` identify, with intervals.

    Args:
        logs: flights of one vehicle; incomplete ones are used for the numbers that they allow.
        vehicle: the start of the fits; a number that is not identifiable keeps its value.
        leave: parts not to fit, of `PARTS`.

    Raises:
        ValueError: if no signal drives the model in all flights, or no fit has a complete window.
    """
    # Run the fits. With motor commands the loop comes last and may use the lag of the torque fit,
    # which is better than its own. Otherwise it comes first: the others use its lag.
    posed_logs = posed([true_log(log, vehicle.effects) for log in logs])
    grids = [grid_of(log) for log in posed_logs]
    drive = common_drive(grids)
    flights = [
        with_ground(flight, log, vehicle, DRIVES[drive][0])
        for flight, log in zip(grids, posed_logs, strict=True)
    ]
    fits = _Fits(flights, with_merged_effects(vehicle, drive in KNOWN_MOTORS), drive, tuple(leave))
    if drive != "pwm":
        fits.fit_loop()
    for _ in range(ROUNDS):
        fits.fit_force()
        fits.fit_torque()
    if drive == "pwm":
        fits.fit_loop()
    lacking = not_attempted(flights, fits.start, drive, fits.results, leave, fits.broken)
    if not fits.results:
        names = ", ".join(flight.name for flight in flights)
        if not leave:
            raise ValueError(
                f"{names}: no stretch of a second with positions or body rates and the signals "
                "that drive the motors; import these flights again and read the report"
            )
        why = "; ".join(lacking) or "no stretch of a second with the needed signals"
        raise ValueError(f"{names}: without {', '.join(leave)} nothing is identifiable: {why}")
    return fits.identified(vehicle, logs, lacking)


class _Fits:
    """The fits of one identification; each starts from the results of those before it."""

    def __init__(
        self, flights: list[FlightGrid], vehicle: Vehicle, drive: str, leave: tuple[str, ...]
    ) -> None:
        self.flights, self.drive, self.leave = flights, drive, leave
        self.driven = driven_vehicle(flights, vehicle, drive, keep_motors="motors" in leave)
        self.start = self.driven.start
        self.results: dict[str, Fitted] = {}
        """Results by the name of the fit: force, torque, rotors or loop."""
        self.broken: set[str] = set()
        """Names of fits without a complete window."""
        self.without_voltage: set[str] = set()
        """Names of flights without a voltage, if others have one."""
        effects, lag_s = all_values(vehicle), vehicle.rotors.time_constant
        self.log_thrust = float(np.log(effects["thrust_scale"].scale))
        """Logarithm of the thrust's scale at the start."""
        late_s = lag_s + float(effects["command_delay"].delay)
        self.numbers = {"thrust": self.log_thrust, "lag": lag_s, "late": late_s}
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
        lag_known = any(fit.identifies("lag") for fit in self.results.values())
        result = self.attempt("torque", fit_torque, unknowns, *inputs, (), lag_known)
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

        By motor commands, these are the flights with a voltage, if any have one.
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

    def identified(
        self, original: Vehicle, logs: Sequence[FlightLog], lacking: Sequence[str]
    ) -> Identified:
        """Return the result of all fits to `logs`, from the unchanged vehicle `original`.

        `lacking` has a line for people for each number that was not fitted.
        """
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
        # Blade flapping needs the results of both fits, and motors whose thrust is known.
        known_motors = self.drive in KNOWN_MOTORS and {"force", "torque"} <= {*results}
        if known_motors and "drag" not in self.leave:
            force, torque = results["force"], results["torque"]
            perturbed = perturbed_vehicles(vehicle, self.driven, force, torque)
            with_voltage = [log for log in logs if log.name not in self.without_voltage]
            flapping = flapping_of(with_voltage, vehicle, perturbed)
            vehicle, more, more_notes = with_entries(vehicle, [flapping] if flapping else [])
            numbers, notes = [*numbers, *more], [*notes, *more_notes]
        file_delay_s = float(all_values(vehicle)["command_delay"].delay)
        fits = [name for name in ("force", "torque") if name in results]
        further = notes_on(self.flights, self.without_voltage, original, vehicle)
        return Identified(
            vehicle,
            tuple(numbers),
            (*not_identified(results, by_key, file_delay_s), *lacking),
            self.drive,
            {name: results[name].residual_rms.tolist() for name in fits},
            (*misfit_notes(results), *further, *notes),
        )
