"""`suite identify`: estimates the numbers of a vehicle file that flights identify.

Force and torque are fitted in turn, each with the other's result, since the rotors' lag acts on
both. Mass is never fitted: scaling it together with inertia and thrust changes no flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from eval.logs.flight_log import FlightLog
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.data.inertial import posed
from suite.diagnose.identify.body import (
    KNOWN,
    fit_force,
    fit_torque,
    lag_and_delay,
    unknowns_of_force,
    unknowns_of_torque,
)
from suite.diagnose.identify.drive import (
    KNOWN_MOTORS,
    drive_of,
    driven_by,
    with_battery,
    with_motors,
    with_own_numbers,
)
from suite.diagnose.identify.entries import (
    enter,
    fast_enough,
    inertia_of,
    of_force,
    of_loop,
    of_torque,
)
from suite.diagnose.identify.fit import Fitted, NothingWhole, Unknown
from suite.diagnose.identify.flapping import flapping_of, perturbed
from suite.diagnose.identify.grid import FlightGrid, grid_of
from suite.diagnose.identify.loop import (
    air_torques,
    couplings,
    fit_loop,
    fit_rotor_lag,
    gains,
)
from suite.diagnose.identify.numbers import (
    Number,
    not_attempted,
    not_identified,
    notes_on,
    values_of,
)

ROUNDS = 2
"""Force and torque in turn."""
NO_LAG_S = 0.004
"""A rotor's lag below this is rejected where the start has a longer one [s]."""


@dataclass(frozen=True)
class Identified:
    """A vehicle, as far as flights identify it."""

    vehicle: Vehicle
    """The start with the numbers that were identified."""
    numbers: tuple[Number, ...]
    """All that were fitted."""
    not_identified: tuple[str, ...]
    """What these flights do not identify, in words; it was left as it was."""
    drive: str
    """What drove the flights: pwm, rotors, torques, rates or thrust."""
    left: dict[str, list[float]]
    """Root mean square of what is left of force per mass and angular acceleration, per axis."""
    flights: tuple[str, ...]
    """Names of those that were used."""
    notes: tuple[str, ...] = ()
    """What was done with these flights that the numbers do not show, in words."""


def identify(logs: Sequence[FlightLog], vehicle: Vehicle, leave: Sequence[str] = ()) -> Identified:
    """Return the numbers of `vehicle` that `logs` identify.

    Args:
        logs: flights of one vehicle; partial ones identify what they have the columns for.
        vehicle: to start from; what is not identifiable stays as it is there.
        leave: what not to fit: any of drag, motors, inertia, lag, loop.

    Raises:
        ValueError: where the flights share no drive, or hold nothing that can be compared.
    """
    flights = [grid_of(log) for log in posed(logs)]
    drive = drive_of(flights)
    given, vehicle = vehicle, with_own_numbers(vehicle, drive in KNOWN_MOTORS)
    state = _Start(flights, vehicle, drive, tuple(leave))
    if drive not in KNOWN_MOTORS:
        state.loop()
    for _ in range(ROUNDS):
        state.force()
        state.torque()
    if drive in KNOWN_MOTORS:
        state.loop()
    if not state.fitted:
        names = ", ".join(flight.name for flight in flights)
        if not leave:
            raise ValueError(
                f"{names}: no stretch of a second with positions or body rates and what drove "
                "it; import them again and read its report"
            )
        lacking = "; ".join(state.lacking()) or "no stretch of a second with what it needs"
        raise ValueError(f"{names}: without {', '.join(leave)} nothing is identifiable: {lacking}")
    found = state.done(given)
    if drive not in KNOWN_MOTORS or "drag" in leave or not {"force", "torque"} <= {*state.fitted}:
        return found
    force_fit, torque_fit = state.fitted["force"], state.fitted["torque"]
    others = perturbed(found.vehicle, state.driven, force_fit, torque_fit)
    entry = flapping_of(
        [log for log in logs if log.name not in state.without_voltage], found.vehicle, others
    )
    if entry is None:
        return found
    vehicle, numbers, notes = enter(found.vehicle, [entry])
    return replace(
        found,
        vehicle=vehicle,
        numbers=(*found.numbers, *numbers),
        notes=(*found.notes, *notes),
    )


class _Start:
    """What is known so far; each fit starts from what the one before has found."""

    def __init__(
        self, flights: list[FlightGrid], vehicle: Vehicle, drive: str, leave: tuple[str, ...]
    ) -> None:
        self.flights, self.start, self.drive, self.leave = flights, vehicle, drive, leave
        if drive == "pwm" and (vehicle.motors is None or "motors" not in leave):
            self.start = with_motors(flights, vehicle)
        self.driven = driven_by(flights, self.start, drive)
        self.lag_s: float = vehicle.rotors.time_constant
        self.delay_s: float = _value(vehicle, "command_delay", "delay", 0.0)
        self.begun_s = self.lag_s
        self.fitted: dict[str, Fitted] = {}
        self.broken: set[str] = set()
        """Fits for which no stretch was whole."""
        self.without_voltage: set[str] = set()
        """Names of flights without a voltage, where others have one."""
        self.begun_scale = float(np.log(_value(vehicle, "thrust_scale", "scale", 1.0)))
        self.scale = self.begun_scale

    def force(self) -> None:
        flights = [f for f in self.flights if f.has("vel_w") or f.has("pos_w")]
        # Where no flight has an attitude, their paths show how they leaned.
        leaning = not any(flight.has("rot_w") for flight in flights)
        flights = [flight for flight in flights if leaning or flight.has("rot_w")]
        if not flights:
            return
        flights = self.with_known_thrust(flights)
        voltage = all(flight.has("voltage") for flight in flights)
        unknowns = unknowns_of_force(self.driven, voltage, leaning, self.begun_scale)
        left = {"drag": ("drag_",), "motors": ("thrust", "curve", "battery")}
        unknowns = _without(unknowns, left, self.leave)
        if not unknowns:
            return
        fixed = {"thrust": self.begun_scale, **self.lags()}
        found = self.tried("force", lambda: fit_force(flights, self.driven, unknowns, fixed))
        if found is not None:
            self.fitted["force"] = found
            self.scale = values_of(found).get("thrust", self.begun_scale)

    def with_known_thrust(self, flights: list[FlightGrid]) -> list[FlightGrid]:
        """Return those with a known thrust of the motors, and remember who the others are."""
        kept = with_battery(flights, self.drive)
        if len(kept) < len(flights):
            self.without_voltage |= {flight.name for flight in flights if not flight.has("voltage")}
        return kept

    def tried(self, name: str, fitted: Callable[[], Fitted]) -> Fitted | None:
        """Return a fit; None where no stretch is whole, which is remembered by its name."""
        try:
            return fitted()
        except NothingWhole:
            self.broken.add(name)
            return None

    def torque(self) -> None:
        flights = [flight for flight in self.flights if flight.has("rate_b")]
        if self.drive in ("rates", "thrust") or not flights:
            return
        unknowns = unknowns_of_torque(self.drive, self.lag_s, self.delay_s)
        left = {"inertia": ("inertia_", "yaw"), "lag": ("lag", "late")}
        unknowns = _without(unknowns, left, self.leave)
        if not unknowns:
            return
        flights = self.with_known_thrust(flights)
        fixed, known = self.lags(), None
        if "force" in self.fitted and self.drive in KNOWN_MOTORS:
            fixed |= values_of(self.fitted["force"])
            known = self.fitted["force"].as_known(*KNOWN)

        def fitted(unknowns: Sequence[Unknown], held: Sequence[str] = ()) -> Fitted:
            return fit_torque(flights, self.driven, unknowns, fixed, held, known)

        found = self.tried("torque", lambda: fitted(unknowns))
        if found is None:
            return
        if found.has("lag") and values_of(found)["lag"] < NO_LAG_S < self.begun_s:
            # No rotor follows at once: what blurs the commands in the log hides its lag.
            self.lag_s = self.begun_s
            unknowns = [u._replace(start=self.begun_s) if u.name == "lag" else u for u in unknowns]
            found = fitted(unknowns, ("lag",))
        self.keep("torque", found)

    def loop(self) -> None:
        """Fit the nominal rate loop, and measured rotor speeds behind commanded ones."""
        both = lag_and_delay(self.lag_s, self.delay_s)
        rotors = ("rotor_speed", "rotor_speed_cmd")
        # Speeds that were polled in turn are blurred, which would be taken for a lag.
        commanded = [f for f in self.flights if f.has(*rotors) and not {*rotors} & {*f.in_turn}]
        if commanded and "lag" not in self.leave:
            found = self.tried("rotors", lambda: fit_rotor_lag(commanded, both))
            if found is not None:
                self.keep("rotors", found)
        flown = [f for f in self.flights if f.has("rate_b", "rate_cmd_b")]
        if not flown or self.start.controller.kind != "p" or "loop" in self.leave:
            return
        # The torque identifies lag and delay of known motors better.
        apart = "rotors" in self.fitted or self.drive == "pwm" or "lag" in self.leave
        source = self.fitted.get("rotors", self.fitted.get("torque"))
        known = source.as_known("late", "lag") if apart and source is not None else None
        wanted = [u for u in both if not apart or (known and u.name in known.names)]
        nuisance = [*couplings(self.start), *air_torques(flown)]
        unknowns = [*gains(), *nuisance, *wanted]
        found = self.tried(
            "loop", lambda: fit_loop(flown, self.start, unknowns, self.lags(), known)
        )
        if found is not None:
            self.keep("loop", found)

    def lags(self) -> dict[str, float]:
        return {"lag": self.lag_s, "late": self.lag_s + self.delay_s}

    def keep(self, name: str, found: Fitted) -> None:
        self.fitted[name] = found
        self.lag_s = values_of(found).get("lag", self.lag_s)
        self.delay_s = values_of(found).get("late", self.lag_s + self.delay_s) - self.lag_s

    def inertia(self) -> tuple[float, float, float]:
        numbers = values_of(self.fitted["torque"]) if "torque" in self.fitted else {}
        x, y, z = inertia_of(self.start, numbers)
        return float(x), float(y), float(z)

    def lacking(self) -> list[str]:
        return not_attempted(
            self.flights, self.start, self.drive, self.fitted, self.leave, self.broken
        )

    def done(self, given: Vehicle) -> Identified:
        """Return what was found, from the vehicle that was `given`."""
        entries = []
        if "force" in self.fitted:
            entries += of_force(self.driven, self.fitted["force"])
        if "torque" in self.fitted:
            entries += of_torque(self.driven, self.fitted["torque"], self.scale, self.lag_s)
        for name in ("rotors", "loop"):
            if name in self.fitted:
                entries += of_loop(self.start, self.fitted[name], self.lag_s)
        kept: dict[str, Number] = {}
        for entry in entries:
            # A later fit is better: it sees the rotors themselves.
            if entry.key not in kept or entry.is_identified:
                kept[entry.key] = entry
        vehicle, numbers, notes = enter(self.start, kept.values())
        if "torque" in self.fitted and self.drive != "rates":
            vehicle = replace(vehicle, inertia=self.inertia())
        if self.drive == "rotors":
            vehicle = fast_enough(vehicle, [f.known["rotor_speed"] for f in self.flights])
        left = {
            name: [float(v) for v in self.fitted[name].left]
            for name in ("force", "torque")
            if name in self.fitted
        }
        return Identified(
            vehicle,
            tuple(numbers),
            (*not_identified(self.fitted, kept), *self.lacking()),
            self.drive,
            left,
            tuple(flight.name for flight in self.flights),
            (*notes_on(self.flights, self.without_voltage, given, vehicle), *notes),
        )


def _value(vehicle: Vehicle, effect: str, key: str, otherwise: Any) -> Any:
    values = vehicle.effects.get(effect)
    return otherwise if values is None else getattr(values, key)


def _without(
    unknowns: Sequence[Any], names: dict[str, tuple[str, ...]], leave: Sequence[str]
) -> list[Any]:
    out = tuple(start for what in leave for start in names.get(what, ()))
    return [u for u in unknowns if not (out and u.name.startswith(out))]
