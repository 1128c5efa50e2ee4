"""The hidden physics of a blind case: values of an effect, or physics that no effect describes.

For physics outside the catalogue of effects the correct verdict is `unknown`. In the shapes, N is
the number of flights.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import GRAVITY
from eval.quadrotor.plant import Command, Motion, Wrench
from eval.vehicles.vehicle import Vehicle
from suite.blind.oracle import columns_in_table, detectable_along
from tracks.geometry.rotation import to_local

Law = Callable[[float, float, Motion, Wrench, float], np.ndarray]
"""Function (strength, true mass [kg], motion, wrench, time [s]) -> acceleration (N, 3), world axes
[m/s^2]."""


class Outside:
    """Physics outside the catalogue, which changes the command or adds a wrench.

    By itself it is an acceleration that is a function of the present state and time. An object may
    have a state, such as the position of a load, so each call of `fly` needs a new one.
    """

    def __init__(self, strength: float, mass: float, law: Law | None = None) -> None:
        """Prepare for flights of a quadrotor of true `mass` [kg], with the acceleration of `law`.

        `strength` is the size of the physics, in the unit that `KINDS` gives.
        """
        self.strength, self.mass, self._law = strength, mass, law

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command that acts instead of `command`."""
        return command

    def wrench(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> Wrench:
        """Return the wrench that is added to `wrench`, the present one; both in body axes.

        `dt` is the length of the step [s].
        """
        acc_w = self.acc_w(motion, wrench, time_s, dt)
        force_b = self.mass * to_local(motion.rot_w, acc_w)
        return Wrench(force_b, np.zeros_like(force_b))

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return an additional acceleration (N, 3), world axes [m/s^2]."""
        if self._law is None:
            return np.zeros_like(motion.pos_w)
        return self._law(self.strength, self.mass, motion, wrench, time_s)


class SlungLoad(Outside):
    """A point mass of `strength` kg on an elastic line below the centre of mass.

    The catalogue has a load too, but on a stiff line.
    """

    LENGTH_M, STIFFNESS, DAMPING = 0.4, 60.0, 0.3
    """Of the line: length without load [m], stiffness [N/m] and damping [N s/m]."""

    _pos_w = _vel_w = np.zeros(0)
    """Position [m] and velocity [m/s] of the load; empty before the first step."""

    def acc_w(self, motion: Motion, wrench: Wrench, time_s: float, dt: float) -> np.ndarray:
        """Return the acceleration by the pull of the line, and move the load by one step.

        At first the load hangs at rest.
        """
        if not self._pos_w.size:
            stretch = self.strength * GRAVITY / self.STIFFNESS
            self._pos_w = motion.pos_w - np.array([0.0, 0.0, self.LENGTH_M + stretch])
            self._vel_w = motion.vel_w.copy()
        line_w = self._pos_w - motion.pos_w
        length = np.sqrt((line_w**2).sum(-1, keepdims=True))
        direction_w = line_w / length
        stretch_rate = ((self._vel_w - motion.vel_w) * direction_w).sum(-1, keepdims=True)
        tension = self.STIFFNESS * (length - self.LENGTH_M) + self.DAMPING * stretch_rate
        force_w = np.where(length > self.LENGTH_M, np.maximum(tension, 0.0), 0.0) * direction_w
        self._vel_w = self._vel_w + dt * (-force_w / self.strength + [0.0, 0.0, -GRAVITY])
        self._pos_w = self._pos_w + dt * self._vel_w
        return force_w / self.mass


class Hysteresis(Outside):
    """Backlash in the collective thrust: the acting thrust follows the command with a play.

    The play is `strength` m/s^2 wide; at the start the command is in its middle.
    """

    _acting = np.zeros(0)
    """(N,) acting thrust per mass [m/s^2]; empty before the first step."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command with the acting thrust, which moves only at the edges of the play."""
        half_width = 0.5 * self.strength
        acting = self._acting if self._acting.size else command.thrust
        self._acting = np.clip(acting, command.thrust - half_width, command.thrust + half_width)
        return Command(np.maximum(self._acting, 0.0), command.rate_b)


class BentThrust(Outside):
    """A nonlinear thrust curve."""

    def command(self, command: Command, time_s: float) -> Command:
        """Return the command with the thrust c + s (c - g)^2 / g.

        c is the commanded thrust, s the strength and g gravity, so a hover does not change.
        """
        thrust = command.thrust
        curved = thrust + self.strength * (thrust - GRAVITY) ** 2 / GRAVITY
        return Command(np.maximum(curved, 0.0), command.rate_b)


def _power_drag(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return a drag that grows with |v|^1.6: -s |v|^0.6 v."""
    speed = np.sqrt((motion.vel_w**2).sum(-1, keepdims=True))
    return -s * speed**0.6 * motion.vel_w


def _heading_force(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return a sideways force that depends on the heading: s cos(2 yaw) along body y."""
    yaw = np.arctan2(motion.rot_w[:, 1, 0], motion.rot_w[:, 0, 0])
    return s * np.cos(2.0 * yaw)[:, None] * motion.rot_w[:, :, 1]


def _wake(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return the loss of thrust in the drone's wake: -s (sink rate beyond 0.5 m/s)^2 on body z."""
    sink_rate = np.maximum(-motion.vel_w[:, 2:] - 0.5, 0.0)
    return -s * sink_rate**2 * motion.rot_w[:, :, 2]


def _tether(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return the pull of a spring to a fixed point: -s (pos - anchor)."""
    return -s * (motion.pos_w - np.array([1.0, -1.0, 0.0]))


def _ripple(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return a thrust oscillation at 3.1 Hz: s sin(2 pi 3.1 t) times the thrust."""
    share = s * np.sin(2.0 * np.pi * 3.1 * t)
    return share * wrench.force_b[:, 2:] / m * motion.rot_w[:, :, 2]


def _updraft(s: float, m: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
    """Return the push of rising air, s exp(-r^2 / (2 (0.9 m)^2)) at a distance r from its axis."""
    distance_squared = ((motion.pos_w[:, :2] - np.array([2.0, 1.0])) ** 2).sum(-1)
    return (s * np.exp(-0.5 * distance_squared / 0.9**2))[:, None] * np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Kind:
    """One kind of physics outside the catalogue."""

    make: Callable[..., Outside]
    """Function (strength, true mass [kg]) -> the physics."""
    unit: str
    usual: float
    """Usual strength; a flight with it shows how detectable this physics is."""
    most: float
    """Largest strength in a case."""


KINDS: dict[str, Kind] = {
    "power_drag": Kind(partial(Outside, law=_power_drag), "m^-0.6 s^-0.4", 0.08, 0.4),
    "slung_load": Kind(SlungLoad, "kg", 0.03, 0.12),
    "hysteresis": Kind(Hysteresis, "m/s^2", 1.0, 3.0),
    "heading_force": Kind(partial(Outside, law=_heading_force), "m/s^2", 0.5, 2.5),
    "wake": Kind(partial(Outside, law=_wake), "1/m", 0.3, 1.2),
    "tether": Kind(partial(Outside, law=_tether), "1/s^2", 0.1, 0.6),
    "ripple": Kind(partial(Outside, law=_ripple), "1", 0.05, 0.3),
    "updraft": Kind(partial(Outside, law=_updraft), "m/s^2", 1.0, 5.0),
    "bent_thrust": Kind(BentThrust, "1", 0.1, 0.4),
}
"""Name of each kind of physics outside the catalogue -> its description."""
BOUND_SHARE = 0.98
"""Largest change of a parameter, as a share of the distance to the physical bound of its value."""


def draw_change(
    rng: np.random.Generator, nominal: Vehicle, sensors: str, effect: str, multiple: float
) -> tuple[np.ndarray, float]:
    """Draw a change of an effect's parameters in a random direction.

    The strength is a `multiple` of the just detectable one, which physical bounds may reduce.
    `sensors` is a key of `SENSORS`.

    Returns:
        The change of each of the P parameter components that the table of strengths has (P,), and
        its strength as a multiple of the just detectable one.

    Raises:
        ValueError: if the effect is not identifiable on the flights of the table.
    """
    columns = columns_in_table(nominal.name, sensors, effect)
    room = np.array([column.room(nominal) for column in columns])
    # 1. A random direction. Some effects change one component only, such as one weak motor.
    if columns[0].spec.one_at_a_time:
        unit_vector = np.eye(len(columns))[rng.integers(len(columns))]
        direction = columns[0].spec.signs[0] * unit_vector
    else:
        sign = rng.choice([-1.0, 1.0], len(columns))
        # A component grows if its value cannot become smaller, or usually does not.
        upwards = (room[:, 0] > -1e-9) | np.array([c.spec.upwards(nominal) for c in columns])
        direction = rng.uniform(0.5, 1.0, len(columns)) * np.where(upwards, 1.0, sign)
    detectable = detectable_along(nominal.name, sensors, effect, direction)
    if not np.isfinite(detectable):
        raise ValueError(
            f"{effect} is not identifiable on vehicle {nominal.name!r} with sensors {sensors!r}; "
            "draw another vehicle or other sensors"
        )
    # 2. The wanted strength in this direction, made smaller if a component would leave its bounds.
    change = multiple * detectable * direction
    limit = BOUND_SHARE * np.where(change > 0.0, room[:, 1], room[:, 0])
    nonzero = np.abs(change) > 0.0
    factor = float(np.min(np.abs(limit[nonzero] / change[nonzero]), initial=1.0))
    return factor * change, factor * multiple


def changed_values(
    nominal: Vehicle, sensors: str, effect: str, change: np.ndarray, rng: np.random.Generator
) -> Any:
    """Return the values of an effect: those in the nominal vehicle, plus a change.

    `change` (P,) is that of each column in the table of strengths. `rng` draws the components that
    are not identifiable.
    """
    nominal_values = all_values(nominal)[effect]
    fields = {k: np.array(value, dtype=float) for k, value in nominal_values._asdict().items()}
    columns = columns_in_table(nominal.name, sensors, effect)
    for column, step in zip(columns, change, strict=True):
        value = fields[column.parameter]
        value[(column.component,) if value.ndim else ()] += step
    for parameter in EFFECTS[effect].parameters:
        for component in parameter.unseen:
            # The component is not identifiable, so a diagnosis need not find its value.
            size = 0.5 * parameter.typical[1]
            fields[parameter.name][component] = rng.uniform(-size, size)
    plain = {k: tuple(v.tolist()) if v.ndim else float(v) for k, v in fields.items()}
    return type(nominal_values)(**plain)


def true_parameters(effect: str, values: Any, has_voltage: bool) -> dict[str, Any]:
    """Return the parameters that a diagnosis should estimate, by name.

    They are whole values, not changes from the nominal ones. A component that is not identifiable
    is None.
    """
    expected: dict[str, Any] = {}
    for parameter in EFFECTS[effect].identifiable(has_voltage):
        value = getattr(values, parameter.name)
        if parameter.size:
            value = [None if i in parameter.unseen else v for i, v in enumerate(value)]
        expected[parameter.name] = value
    return expected
