"""A quadrotor as its vehicle file describes it: frozen, hashable, plain Python numbers.

Body frame: x forward, y left, z up, origin at the nominal centre of mass. SI units.

A motor's thrust by `[motors]` is `T = t1 u + t2 u^2` with `u = command (V / V0)^n`: command from 0
to 1, V the battery's voltage, V0 the nominal one. n = 1 where the command is a share of the
battery's voltage (PWM of a brushed motor), n = 0 where the firmware compensates the battery.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from tracks.geometry.camera import Camera

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Rotors:
    """Four rotors with parallel axes along body z."""

    position: tuple[Vector, Vector, Vector, Vector]
    """Hubs in body axes [m]."""
    spin: tuple[int, int, int, int]
    """s_i: +1 turns counter-clockwise seen from above, -1 clockwise."""
    thrust_coefficient: float
    """k_T [N/(rad/s)^2]."""
    torque_coefficient: float
    """k_Q [N m/(rad/s)^2]."""
    time_constant: float
    """tau_m of the first-order lag [s]; 0 follows at once."""
    speed_max: float
    """Largest commanded speed [rad/s]."""

    @property
    def thrust_max(self) -> float:
        """Largest commanded thrust of one rotor, f_max [N]."""
        return self.thrust_coefficient * self.speed_max**2


@dataclass(frozen=True)
class Controller:
    """The loops that turn an attitude into rates and rates into torque."""

    rate_gain: Vector
    """K of the rate loop [1/s]; a firmware's loop uses its settings instead."""
    frequency: float
    """Rate of the rate loop, and of the physics [Hz]."""
    attitude_gain: Vector = (8.0, 8.0, 4.0)
    """Body rate per attitude error [1/s]."""
    rate_max: Vector = (6.0, 6.0, 6.0)
    """Commanded body rates are clipped to this [rad/s]."""
    kind: str = "p"
    """The nominal rate loop `p`, or a firmware's, one of `eval.quadrotor.loops.KINDS`."""
    settings: Any = None
    """That firmware's settings, `Settings` of its module; None for `p`."""


@dataclass(frozen=True)
class MotorMap:
    """Thrust of a motor command: the vehicle file's `[motors]`; see `motor_thrust`."""

    thrust: tuple[float, float]
    """t1, t2 of T = t1 u + t2 u^2 [N], u the applied command."""
    voltage: float
    """V0, the battery's nominal voltage [V]."""
    voltage_exponent: float = 1.0
    """n of u = command (V / V0)^n; 0 where the firmware compensates the battery."""


@dataclass(frozen=True)
class CollisionBox:
    """The box for collisions: the vehicle file's `[body]`."""

    half_size: Vector = (0.064, 0.064, 0.025)
    """Half of the edges of a box around the origin [m]."""


@dataclass(frozen=True)
class Vehicle:
    """A quadrotor: the nominal constants that its controller uses, and its effects."""

    name: str
    mass: float
    """Nominal [kg]."""
    inertia: Vector
    """Nominal, principal, body axes [kg m^2]."""
    rotors: Rotors
    controller: Controller
    body: CollisionBox = field(default_factory=CollisionBox)
    camera: Camera = field(default_factory=Camera)
    motors: MotorMap | None = None
    """Thrust of motor commands; None where unknown."""
    effects: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Values (the effect's NamedTuple) by the effect's name, see `eval.effects.EFFECTS`."""

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled and copied: a read-only view of a dict cannot be."""
        return {**vars(self), "effects": dict(self.effects)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, effects=MappingProxyType(state["effects"]))

    @property
    def full_thrust(self) -> float:
        """Nominal largest collective thrust per mass [m/s^2]; a share of it is a throttle."""
        return 4.0 * self.rotors.thrust_max / self.mass


def with_effects(nominal: Vehicle, effects: Mapping[str, Any]) -> Vehicle:
    """Return `nominal` with `effects`, values by name, in place of its own of these names."""
    return replace(nominal, effects=MappingProxyType({**nominal.effects, **effects}))


def motor_thrust(motors: MotorMap, command: Any, voltage: Any = None) -> Any:
    """Return the thrusts (..., 4) [N].

    Args:
        motors: the map.
        command: (..., 4) from 0 to 1.
        voltage: (...,) of the battery [V]; None: the nominal one.
    """
    applied = command
    if voltage is not None and motors.voltage_exponent:
        applied = command * ((voltage / motors.voltage) ** motors.voltage_exponent)[..., None]
    first, second = motors.thrust
    return first * applied + second * applied**2


def command_of_thrust(curve: tuple[Any, Any], thrust: Any) -> Any:
    """Return the applied command u of `T = t1 u + t2 u^2` for thrusts (...) >= 0 [N].

    Args:
        curve: t1, t2 [N] of an increasing curve.
        thrust: [N].
    """
    first, second = curve
    xp = thrust.__array_namespace__()
    root = xp.sqrt(xp.maximum(first**2 + 4.0 * second * thrust, 1e-12))
    return 2.0 * thrust / xp.maximum(first + root, 1e-6)


def motor_speed(vehicle: Vehicle, command: Any, voltage: Any = None) -> Any:
    """Return the commanded rotor speeds (..., 4) [rad/s] of motor commands; see `motor_thrust`.

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
