"""The `Vehicle`: a quadrotor as its vehicle file (TOML) describes it, in plain Python numbers.

The dataclasses are frozen. The body frame is x forward, y left, z up, with its origin at the
nominal centre of mass. Units are SI.

The table `[motors]` gives a motor's thrust as `T = t1 u + t2 u^2` with `u = command (V / V0)^n`,
where the command is from 0 to 1, V is the battery's voltage and V0 its nominal voltage. n is 1 if
the command is a share of the battery's voltage (PWM of a brushed motor), and 0 if the firmware
compensates the voltage.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from tracks.geometry.camera import Camera

Vector = tuple[float, float, float]
"""Components along x, y and z."""


@dataclass(frozen=True)
class Rotors:
    """Four rotors with parallel axes along body z."""

    position: tuple[Vector, Vector, Vector, Vector]
    """Positions of the hubs in body axes [m]."""
    spin: tuple[int, int, int, int]
    """s_i: +1 turns counter-clockwise seen from above, -1 clockwise."""
    thrust_coefficient: float
    """k_T: thrust of a rotor over its squared speed [N/(rad/s)^2]."""
    torque_coefficient: float
    """k_Q: torque of a rotor over its squared speed [N m/(rad/s)^2]."""
    time_constant: float
    """tau_m: time constant with which rotor speeds follow commands [s]; 0: at once."""
    speed_max: float
    """Largest commanded rotor speed [rad/s]."""

    @property
    def thrust_max(self) -> float:
        """Largest commanded thrust of one rotor, f_max [N]."""
        return self.thrust_coefficient * self.speed_max**2


@dataclass(frozen=True)
class Controller:
    """The attitude loop (attitude error to body rates) and the rate loop (body rates to torque)."""

    rate_gain: Vector
    """K: gain of the nominal rate loop [1/s]; a firmware's loop uses its settings instead."""
    frequency: float
    """Frequency of the rate loop, and of the physics [Hz]."""
    attitude_gain: Vector = (8.0, 8.0, 4.0)
    """Gain of the attitude loop: body rate per attitude error [1/s]."""
    rate_max: Vector = (6.0, 6.0, 6.0)
    """Largest commanded body rates [rad/s]."""
    kind: str = "p"
    """Kind of rate loop: the nominal one `p`, or a firmware in `eval.quadrotor.loops.KINDS`."""
    settings: Any = None
    """Settings of the firmware's loop, `Settings` of its module; None for `p`."""

    def overshoots(self, step_s: float) -> bool:
        """Return whether the nominal rate loop overshoots at every physics step of `step_s` [s]."""
        return self.kind == "p" and max(self.rate_gain) * step_s > 1.0


@dataclass(frozen=True)
class MotorMap:
    """Thrust of a motor command: the vehicle file's `[motors]`; see `motor_thrust`."""

    thrust: tuple[float, float]
    """Coefficients t1, t2 of the thrust T = t1 u + t2 u^2 [N] of an applied command u."""
    voltage: float
    """V0: the battery's nominal voltage [V]."""
    voltage_exponent: float = 1.0
    """Exponent n of u = command (V / V0)^n; 0 if the firmware compensates the voltage."""


@dataclass(frozen=True)
class CollisionBox:
    """The box for collisions: the vehicle file's `[body]`."""

    half_size: Vector = (0.064, 0.064, 0.025)
    """Half edge lengths of a box around the origin [m]."""


@dataclass(frozen=True)
class Vehicle:
    """A quadrotor: the nominal constants that its controller uses, and its effects."""

    name: str
    mass: float
    """Nominal mass [kg]."""
    inertia: Vector
    """Nominal principal moments of inertia, body axes [kg m^2]."""
    rotors: Rotors
    controller: Controller
    body: CollisionBox = field(default_factory=CollisionBox)
    camera: Camera = field(default_factory=Camera)
    motors: MotorMap | None = None
    """Thrust of motor commands; None where unknown."""
    effects: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Values (the effect's NamedTuple) by name of the effect; see `eval.effects.EFFECTS`."""

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for pickle and copy, which do not support the read-only `effects`."""
        return {**vars(self), "effects": dict(self.effects)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, effects=MappingProxyType(state["effects"]))

    @property
    def full_thrust(self) -> float:
        """Thrust per nominal mass of four rotors at `speed_max`, also with `[motors]` [m/s^2].

        A policy or a companion computer can command no larger one.
        """
        return 4.0 * self.rotors.thrust_max / self.mass


def with_effects(nominal: Vehicle, effects: Mapping[str, Any]) -> Vehicle:
    """Return `nominal` with `effects` (values by name) added to its own, or replacing them."""
    return replace(nominal, effects=MappingProxyType({**nominal.effects, **effects}))


def motor_thrust(motors: MotorMap, command: Any, voltage: Any = None) -> Any:
    """Return the thrusts (..., 4) [N] of motor commands.

    Commands (..., 4) are from 0 to 1. Without a battery voltage (...,) [V] it is the nominal one.
    """
    applied = command
    if voltage is not None and motors.voltage_exponent:
        applied = command * ((voltage / motors.voltage) ** motors.voltage_exponent)[..., None]
    first, second = motors.thrust
    return first * applied + second * applied**2


def command_of_thrust(curve: tuple[Any, Any], thrust: Any) -> Any:
    """Return the applied command u of `T = t1 u + t2 u^2` for thrusts (...) >= 0 [N].

    `curve` is t1, t2 [N] of an increasing curve.
    """
    first, second = curve
    xp = thrust.__array_namespace__()
    # The root of the quadratic in the form that also holds for t2 = 0.
    root = xp.sqrt(xp.maximum(first**2 + 4.0 * second * thrust, 1e-12))
    return 2.0 * thrust / xp.maximum(first + root, 1e-6)


def motor_speed(vehicle: Vehicle, command: Any, voltage: Any = None) -> Any:
    """Return the commanded rotor speeds (..., 4) [rad/s] for motor commands.

    Commands (..., 4) are from 0 to 1. Without a battery voltage (...,) [V] it is the nominal one.

    Raises:
        ValueError: where the vehicle has no `[motors]`.
    """
    if vehicle.motors is None:
        raise ValueError(
            f"vehicle {vehicle.name!r} has no [motors]: the thrust of a motor command is unknown; "
            "add it, or let `suite identify` estimate it"
        )
    thrust = motor_thrust(vehicle.motors, command, voltage)
    xp = thrust.__array_namespace__()
    return xp.sqrt(xp.maximum(thrust, 0.0) / vehicle.rotors.thrust_coefficient)
