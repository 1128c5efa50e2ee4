"""What drove a flight, as thrusts, forces and torques on its grid, and the vehicle of the start.

Effects of the start that are another word for its numbers are in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from eval.quadrotor.plant import make_plant
from eval.vehicles.vehicle import MotorMap, Vehicle
from eval.vehicles.vehicle_check import check_vehicle
from suite.diagnose.identify.grid import STEP_S, FlightGrid

DRIVES = {
    "rotors": ("rotor_speed",),
    "pwm": ("pwm",),
    "torques": ("thrust_cmd", "torque_cmd_b"),
    "rates": ("thrust_cmd", "rate_cmd_b"),
    "thrust": ("thrust_cmd",),
}
"""Signals by drive; the first that all flights have counts."""


class MotorGuess(NamedTuple):
    """A motor's thrust [N]: `size ((1 - curve) v + curve v^2)` with `v = command / usual`.

    The command is that of the voltage `volts`: `command (V / volts)^battery`.
    """

    size: float
    curve: float
    battery: float
    usual: float
    volts: float


def drive_of(flights: Sequence[FlightGrid]) -> str:
    """Return the name of what drives all of `flights`.

    Raises:
        ValueError: where they share nothing.
    """
    for name, signals in DRIVES.items():
        if all(flight.has(*signals) for flight in flights):
            return name
    raise ValueError(
        "the flights share no drive: every one needs rotor speeds, motor commands (pwm_1 to "
        "pwm_4), or a thrust command; those of another kind can be identified apart"
    )


def with_battery(flights: Sequence[FlightGrid], drive: str) -> list[FlightGrid]:
    """Return those whose motors' thrust is known as well as it can be.

    What motors give hangs on the battery: where some flights have its voltage, the others only blur
    what these tell.
    """
    have = [flight for flight in flights if flight.has("voltage")]
    return have if have and drive == "pwm" else list(flights)


def with_motors(flights: Sequence[FlightGrid], vehicle: Vehicle) -> Vehicle:
    """Return the vehicle with `[motors]`: full speed at full command where it had none.

    Flights without a voltage give them an exponent of 0. With that the nominal voltage says
    nothing, so that it may as well be the usual one of flights that have one.
    """
    motors = vehicle.motors
    if motors is None:
        exponent = 1.0 if any(flight.has("voltage") for flight in flights) else 0.0
        motors = MotorMap((0.0, vehicle.rotors.thrust_max), 1.0, exponent)
    elif motors.voltage_exponent:
        return vehicle
    return replace(vehicle, motors=replace(motors, voltage=_volts(flights, motors.voltage)))


def _volts(flights: Sequence[FlightGrid], otherwise: float) -> float:
    have = [f.known["voltage"] for f in flights if f.has("voltage")]
    return float(np.nanmedian(np.concatenate(have))) if have else otherwise


def guess_of(flights: Sequence[FlightGrid], vehicle: Vehicle) -> MotorGuess:
    """Return the start's motors about the command and the voltage that are usual here."""
    motors = vehicle.motors
    assert motors is not None
    usual = float(np.nanmedian(np.concatenate([f.known["pwm"].ravel() for f in flights])))
    volts = _volts(flights, motors.voltage)
    first, second = motors.thrust
    v = usual * (volts / motors.voltage) ** motors.voltage_exponent
    size = first * v + second * v**2
    return MotorGuess(size, second * v**2 / size, motors.voltage_exponent, usual, volts)


def delayed(values: np.ndarray, delay_s: float) -> np.ndarray:
    """Return what held `values` (G, ...) were `delay_s` ago; before the first row, the first.

    A value that holds from one grid point to the next is met half of it later.
    """
    steps = delay_s / STEP_S + 0.5
    whole = int(np.floor(steps))
    part = steps - whole
    near, far = _shifted(values, whole), _shifted(values, whole + 1)
    return (1.0 - part) * near + part * far


def lagged(values: np.ndarray, lag_s: float) -> np.ndarray:
    """Return `values` (G, C), joined by lines, behind a first-order lag."""
    from scipy.signal import lfilter

    if lag_s <= 1e-4:
        return values
    keep = float(np.exp(-STEP_S / lag_s))
    whole = filled(values)
    # The state at a grid point has seen the steps before it, each at its mean.
    before = 0.5 * (np.concatenate([whole[:1], whole[:-1]]) + whole)
    out = lfilter([1.0 - keep], [1.0, -keep], before, axis=0, zi=keep * whole[:1])[0]
    return np.where(np.isfinite(values), out, np.nan)


def motor_thrusts(
    flight: FlightGrid, guess: MotorGuess, lag_s: float, delay_s: float
) -> np.ndarray:
    """Return the motors' thrusts (G, 4) [N]; the rotors' speeds lag, and thrust is their square."""
    command = flight.known["pwm"]
    if flight.has("voltage"):
        ratio = np.maximum(flight.known["voltage"], 0.1) / guess.volts
        command = command * (ratio**guess.battery)[:, None]
    v = delayed(command, delay_s) / guess.usual
    thrust = guess.size * ((1.0 - guess.curve) * v + guess.curve * v**2)
    speed = lagged(np.sqrt(np.maximum(thrust, 0.0)), lag_s)
    return speed**2


def rotor_thrusts(flight: FlightGrid, thrust_coefficient: float) -> np.ndarray:
    """Return the thrusts (G, 4) [N] of measured rotor speeds."""
    return thrust_coefficient * flight.known["rotor_speed"] ** 2


def torque_of(vehicle: Vehicle, thrust: np.ndarray) -> np.ndarray:
    """Return the torques (G, 3) [N m] of rotor thrusts (G, 4) on the vehicle's arms."""
    x, y, _ = np.asarray(vehicle.rotors.position).T
    spin = np.asarray(vehicle.rotors.spin, dtype=float)
    arm = vehicle.rotors.torque_coefficient / vehicle.rotors.thrust_coefficient
    return np.stack([thrust @ y, -(thrust @ x), -arm * (thrust @ spin)], axis=1)


def _shifted(values: np.ndarray, steps: int) -> np.ndarray:
    if steps == 0:
        return values
    if steps > 0:
        return np.concatenate([np.repeat(values[:1], steps, axis=0), values[:-steps]])
    return np.concatenate([values[-steps:], np.repeat(values[-1:], -steps, axis=0)])


def filled(values: np.ndarray) -> np.ndarray:
    """Return `values` (G, C) with the last known in the place of NaN."""
    good = np.isfinite(values).all(axis=1)
    last = np.maximum.accumulate(np.where(good, np.arange(len(values)), 0))
    first = int(np.argmax(good))
    return np.nan_to_num(values[np.maximum(last, first)])


OWN = ("motor_lag", "inertia_scale", "rate_gain")
"""Effects that scale or replace a number which is fitted."""
FITTED = ("linear_drag", "blade_flapping", "command_delay", "thrust_scale")
"""Effects that are entries of what is found, and start from where the file has them."""


def with_own_numbers(vehicle: Vehicle, known_motors: bool) -> Vehicle:
    """Return `vehicle` with the numbers that its effects scale or replace, without these.

    It flies as before. Left beside the number that flights tell they would count twice.

    Args:
        vehicle: as it was given.
        known_motors: the motors' own thrust is fitted, and no scale of what was commanded, so that
            the effect of that name is one of these as well.

    Raises:
        ValueError: where no file may hold such numbers, as of rotors that are too weak to hover.
    """
    names = (*OWN, "thrust_scale") if known_motors else OWN
    own = {name: values for name, values in vehicle.effects.items() if name in names}
    if not own:
        return vehicle
    rotors, motors = vehicle.rotors, vehicle.motors
    true = make_plant(vehicle, 1.0 / vehicle.controller.frequency, own).constants
    push = float(true.thrust_coefficient[0])
    if motors is not None:
        first, second = np.asarray(motors.thrust) * (push / rotors.thrust_coefficient)
        motors = replace(motors, thrust=(float(first), float(second)))
    rotors = replace(rotors, thrust_coefficient=push, time_constant=float(true.time_constant))
    found = replace(
        vehicle,
        rotors=rotors,
        motors=motors,
        controller=replace(vehicle.controller, rate_gain=_three(true.rate_gain)),
        effects=MappingProxyType({n: v for n, v in vehicle.effects.items() if n not in own}),
    )
    try:
        # The scale of the inertia may be more than a body can have; the fit makes it possible.
        check_vehicle(found)
    except ValueError as error:
        raise ValueError(f"{vehicle.name} with its {', '.join(own)}: {error}") from error
    return replace(found, inertia=_three(true.inertia))


def unknown_to_the_fits(vehicle: Vehicle) -> Sequence[str]:
    """Return the effects of a start that no fit takes into account, and that stay in its file."""
    return [name for name in vehicle.effects if name not in (*OWN, *FITTED)]


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = values
    return float(x), float(y), float(z)
