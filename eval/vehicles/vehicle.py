"""A quadrotor as its vehicle file describes it: frozen, hashable, plain Python numbers.

Body frame: x forward, y left, z up, origin at the nominal centre of mass. SI units.
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
        """Largest thrust that is asked of one rotor, f_max [N]."""
        return self.thrust_coefficient * self.speed_max**2


@dataclass(frozen=True)
class Controller:
    """The loops that turn an attitude into rates and rates into torque."""

    rate_gain: Vector
    """K of the rate loop [1/s]; a firmware's loop has its settings in place of it."""
    frequency: float
    """Of the rate loop, which is the physics rate too [Hz]."""
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
    """What thrust a motor command gives: the vehicle file's `[motors]`; see `vehicles.motors`."""

    thrust: tuple[float, float]
    """t1, t2 of T = t1 u + t2 u^2 [N], u the applied command."""
    voltage: float
    """V0, the battery's nominal voltage [V]."""
    voltage_exponent: float = 1.0
    """n of u = command (V / V0)^n; 0 where the firmware makes up for the battery."""


@dataclass(frozen=True)
class CollisionBox:
    """What collides: the vehicle file's `[body]`."""

    half_size: Vector = (0.064, 0.064, 0.025)
    """Half of the edges of a box around the origin [m]."""


@dataclass(frozen=True)
class Vehicle:
    """A quadrotor: what its controller believes (the nominal), and the effects that are true."""

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
    """What motor commands give, where it is known."""
    effects: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    """Values (the effect's NamedTuple) by the effect's name, see `eval.effects.EFFECTS`."""

    @property
    def full_thrust(self) -> float:
        """Nominal largest collective thrust per mass [m/s^2]; a share of it is a throttle."""
        return 4.0 * self.rotors.thrust_max / self.mass


def with_effects(nominal: Vehicle, effects: Mapping[str, Any]) -> Vehicle:
    """Return `nominal` with `effects`, values by name, in place of its own of these names."""
    return replace(nominal, effects=MappingProxyType({**nominal.effects, **effects}))
