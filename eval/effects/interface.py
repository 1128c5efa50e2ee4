"""The `Effect` dataclass: a physical cause of a mismatch, its parameters and its equations.

An effect changes the nominal quadrotor (the vehicle file's) through functions called hooks, such as
`force`. They take numpy and JAX arrays of any leading batch shape, so the judge in MuJoCo, the MJX
simulator and the differentiable quadrotor all use the same code. With neutral values an effect
changes nothing, so a model may contain all effects at once and fit any of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tracks.geometry.scene import Array

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle


GRAVITY = 9.81
"""Magnitude of gravity [m/s^2]."""
SIGNALS = ("acc_b", "command")
"""Signals that an effect may need: an accelerometer; commands, for an effect between these and the
rotor speeds."""


class Constants(NamedTuple):
    """The true constants of a quadrotor; the controller's nominal ones are in `plant.Nominal`."""

    mass: Array
    """(...,) mass [kg]."""
    inertia: Array
    """(..., 3) principal moments of inertia, body axes, about the centre of mass [kg m^2]."""
    gravity_w: Array
    """(..., 3) acceleration of gravity [m/s^2]."""
    com_offset_b: Array
    """(..., 3) true minus nominal centre of mass [m]."""
    rotor_position_b: Array
    """(..., 4, 3) rotor hubs relative to the true centre of mass [m]."""
    thrust_coefficient: Array
    """(..., 4) k_T: thrust of each rotor over its squared speed [N/(rad/s)^2]."""
    torque_coefficient: Array
    """(..., 4) k_Q: torque of each rotor over its squared speed [N m/(rad/s)^2]."""
    thrust_axis_b: Array
    """(..., 3) unit vector along the total thrust."""
    time_constant: Array
    """(...,) time constant with which the rotor speeds follow their commands [s]."""
    rate_gain: Array
    """(..., 3) gain of the rate loop [1/s]."""
    delay: Array
    """(...,) delay of the commands [s]."""


class Flow(NamedTuple):
    """Inputs of an effect's hooks in one physics step."""

    constants: Constants
    pos_w: Array
    """(..., 3) position of the centre of mass [m]."""
    rot_w: Array
    """(..., 3, 3) attitude, body to world."""
    air_vel_b: Array
    """(..., 3) v_b: velocity of the centre of mass relative to the air, body axes [m/s]."""
    rate_b: Array
    """(..., 3) body rates [rad/s]."""
    rotor_speed: Array
    """(..., 4) Omega_i: mean rotor speeds over the step [rad/s]."""
    spin: Array
    """(4,) s_i: +1 for a rotor turning counter-clockwise seen from above, -1 clockwise."""
    time_s: Array
    """(...,) time since the start of the flight (the first row of its log) [s]."""
    voltage_drop: Array | None
    """(...,) battery voltage at the start of the flight minus now [V]; None if unknown."""
    rotor_acc: Array | None = None
    """(..., 4) mean rate of change of the rotor speeds over the step [rad/s^2]. It is computed only
    if an effect sets `Effect.rotor_acc`; None if it is unknown."""
    memory: Any = None
    """State of this effect before the step; None for an effect without `start` and `carry`."""
    dt: Any = None
    """Length of the step [s]; only for an effect with a state."""


class Gust(NamedTuple):
    """Inputs of the `wind` hook in one physics step."""

    velocity_w: Array
    """(..., 3) wind of this effect in the previous step [m/s]."""
    air_vel_w: Array
    """(..., 3) velocity of the centre of mass relative to the mean wind [m/s]."""
    noise: Array | None
    """(..., 3) standard normal random numbers of this step; None for no turbulence."""
    dt: Array
    """Length of the step [s]."""


Bound = float | Callable[["Vehicle"], float]
"""A number, or a function that returns it for the vehicle that has the effect."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect: its bounds and its usual size."""

    name: str
    """Name in vehicle files and diagnoses."""
    unit: str
    """SI unit."""
    neutral: Bound
    """Value of each component with which the effect changes nothing."""
    low: Bound
    """Smallest physical value of each component."""
    high: Bound
    """Largest physical value of each component."""
    typical: tuple[float, float]
    """Smallest and largest usual difference from neutral, on a racing quadrotor of 0.5 to 1 kg."""
    size: int = 0
    """Number of components; 0 for a plain number."""
    required: bool = True
    """Whether a vehicle file must contain it; otherwise its default is the neutral value."""
    fitted: bool = True
    """Whether it is identifiable from flights; if not, it is a known constant of the vehicle."""
    unseen: tuple[int, ...] = ()
    """Indices of the components that are not identifiable from flights; a diagnosis reports them as
    null."""
    voltage: bool | None = None
    """True: acts only if the log has a voltage; False: only if it has none; None: in both cases."""
    one_at_a_time: bool = False
    """Whether each component is a separate defect (such as one weak motor), of which a vehicle
    usually has only one."""
    whole: bool = False
    """Whether `typical` is a range of the values themselves, not of differences from neutral."""
    signs: tuple[int, ...] = (1,)
    """Usual signs of the difference from neutral; one sign if both signs are equivalent."""
    tried: tuple[float, ...] = ()
    """Further values that a diagnosis tries, if the model is far from linear in the parameter: a
    delay moves jumps of the commands past the rows of a log."""
    direction: tuple[float, ...] = ()
    """Unit vector that divides the usual size among the components; (): each component has the full
    size."""

    def upwards(self, vehicle: Vehicle) -> bool:
        """Return whether the values of a present effect are all above those of an absent one."""
        absent = 0.0 if self.whole else bound_value(self.neutral, vehicle)
        return bound_value(self.low, vehicle) >= absent


Values = Any
"""The values of an effect: its NamedTuple class, with floats, tuples or arrays as fields."""
Memory = Any
"""The state of an effect: arrays (..., K), or nested tuples and dicts of them."""


class Sample(NamedTuple):
    """Signals of a flight log at one or many times, which a fault of the log (a bias) changes."""

    pos_w: Array
    """(..., 3) position [m]."""
    rot_w: Array
    """(..., 3, 3) attitude, body to world."""
    vel_w: Array
    """(..., 3) velocity [m/s]."""
    rate_b: Array
    """(..., 3) body rates [rad/s]."""
    acc_b: Array
    """(..., 3) specific force [m/s^2]."""


@dataclass(frozen=True)
class Effect:
    """A physical effect, or a fault of the log; every hook (the functions below) is optional."""

    name: str
    """Name in vehicle files and diagnoses."""
    summary: str
    """A short description for people."""
    equation: str
    """The change to the nominal quadrotor's equations."""
    source: str
    """Publication of the equation."""
    values: type
    """NamedTuple class with a field for each parameter, in order."""
    parameters: tuple[Parameter, ...]
    constants: Callable[[Values, Constants], Constants] | None = None
    """Returns the changed constants."""
    wind: Callable[[Values, Gust], Array] | None = None
    """Returns this effect's wind velocity in the world (..., 3) [m/s]."""
    gust: Callable[[Values, Array], Array] | None = None
    """For random wind: returns the wind at the start from normal random numbers (..., 3)."""
    thrust: Callable[[Values, Flow, Array], Array] | None = None
    """Takes and returns the rotors' thrusts (..., 4) [N]."""
    force: Callable[[Values, Flow], Array] | None = None
    """Returns an additional force on the centre of mass in body axes (..., 3) [N]."""
    torque: Callable[[Values, Flow], Array] | None = None
    """Returns an additional torque in body axes (..., 3) [N m]."""
    start: Callable[[Values, Flow], Memory] | None = None
    """For an effect with a state, such as a swinging load; it needs `carry` too. Returns the state
    for a vehicle that hovered until now. The other hooks read the state as `Flow.memory`."""
    carry: Callable[[Values, Flow, Array], Memory] | None = None
    """Returns the state after the step, from the acceleration of the centre of mass during the step
    in the world (..., 3) [m/s^2]."""
    measure: Callable[[Values, Sample], Sample] | None = None
    """For a fault of the log: returns the logged sample for the true sample. Applied with the
    values mirrored about neutral, it must undo the fault, at least to first order."""
    late: Callable[[Values], Array] | None = None
    """For a fault of the log: returns the delay with which poses and velocities are logged [s]."""
    of_log: bool = False
    """Whether the effect belongs to the log instead of the vehicle, even if it acts in the
    simulated flight (a tilted world frame)."""
    needs: tuple[str, ...] = ()
    """Signals of `SIGNALS` that a log must contain so that the effect is identifiable."""
    rotor_acc: bool = False
    """Whether it uses `Flow.rotor_acc`."""
    slow: bool = False
    """Whether it develops over minutes of flight, so that it is hardly visible within seconds."""
    with_voltage: Callable[[Values, float], Values] | None = None
    """For an effect of the battery: converts a loss of thrust per second to an equal loss per volt,
    for a voltage that falls at the given rate [V/s]."""
    read: Callable[[Mapping[str, Any]], Values] | None = None
    """Reads a vehicle file's table, where its keys are not the parameters' names."""
    write: Callable[[Values], dict[str, Any]] | None = None
    """The inverse of `read`."""

    @property
    def in_flight(self) -> bool:
        """Whether it changes the flight itself; False where it changes only the log."""
        return self.measure is None and self.late is None

    @property
    def random(self) -> bool:
        """Whether it uses random numbers, so that a rollout does not reproduce it."""
        return self.gust is not None

    @property
    def by_state(self) -> bool:
        """Whether it depends only on the measured state, so that a rollout may start at any row.

        False for an effect with random numbers, or with a state of its own, such as a slung load.
        """
        return not self.random and self.start is None

    @property
    def nameable(self) -> bool:
        """Whether a diagnosis may name it: at least one parameter is identifiable from flights."""
        return bool(self.identifiable(True) or self.identifiable(False))

    def identifiable(self, voltage: bool) -> tuple[Parameter, ...]:
        """Return the parameters that are identifiable from logs with a voltage, or without one.

        An effect with a state has none, since a log does not contain that state.
        """
        if self.start is not None:
            return ()
        return tuple(p for p in self.parameters if p.fitted and p.voltage in (None, voltage))

    def components(self, voltage: bool) -> tuple[tuple[Parameter, int], ...]:
        """Return (parameter, index) of all identifiable components; index 0 for a plain number."""
        return tuple(
            (p, k)
            for p in self.identifiable(voltage)
            for k in range(p.size or 1)
            if k not in p.unseen
        )


def bound_value(bound: Bound, vehicle: Vehicle) -> float:
    """Return `bound`, a number or a function of the vehicle, as a number for `vehicle`."""
    return float(bound(vehicle) if callable(bound) else bound)


def neutral(effect: Effect, vehicle: Vehicle) -> Values:
    """Return the values with which `effect` changes nothing on `vehicle`."""

    def value(parameter: Parameter) -> Any:
        number = bound_value(parameter.neutral, vehicle)
        return (number,) * parameter.size if parameter.size else number

    return effect.values(*(value(parameter) for parameter in effect.parameters))


def as_arrays(values: Values) -> Values:
    """Return an effect's `values` with numbers and tuples as float arrays; JAX arrays are kept."""

    def convert(value: Any) -> Array:
        if hasattr(value, "__array_namespace__"):
            return value
        return np.asarray(value, dtype=float)

    return type(values)(*(convert(value) for value in values))


def per_axis(value: Array) -> Array:
    """Return scalars (...,) as (..., 1), to multiply vectors (..., 3) or rotors (..., 4)."""
    return value[..., None]


def along_z(value: Array) -> Array:
    """Return value e3 (..., 3) for `value` (...,)."""
    xp = value.__array_namespace__()
    return xp.stack([xp.zeros_like(value), xp.zeros_like(value), value], axis=-1)


def cross_e3(vector: Array) -> Array:
    """Return vector x e3, (..., 3)."""
    xp = vector.__array_namespace__()
    return xp.stack([vector[..., 1], -vector[..., 0], xp.zeros_like(vector[..., 0])], axis=-1)


def tilted_e3(angle: Array) -> Array:
    """Return Rot(a_x, a_y, 0) e3 (..., 3) for `angle` (..., 2) [rad].

    The rotation is about x first and then about the fixed y axis (roll, pitch, no yaw).
    """
    xp = angle.__array_namespace__()
    about_x, about_y = angle[..., 0], angle[..., 1]
    return xp.stack(
        [xp.sin(about_y) * xp.cos(about_x), -xp.sin(about_x), xp.cos(about_y) * xp.cos(about_x)],
        axis=-1,
    )
