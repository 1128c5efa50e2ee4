"""Which flights tell apart effects that ordinary flights leave in one set."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from suite.diagnose.estimate.parameters import effects_in
from suite.diagnose.plans.trajectory import Trajectory

_FAST_WOBBLE = Trajectory("figure_eight", speed=6.5, size=4.0, turn="wobble")
_SWEEP = Trajectory("speed_range", speed=8.0, size=6.0, turn="sweep")
_CHIRP = Trajectory("chirp", speed=1.6, turn="wobble")
_PUNCHES = Trajectory("punches", speed=4.0, size=4.0)
_RANGE = Trajectory("speed_range", speed=9.0, size=7.0)
_CIRCLE = Trajectory("circle", speed=3.0, size=3.0)
_SLOW_EIGHT = Trajectory("figure_eight", speed=2.0, size=3.0)
_HOVER = Trajectory("hover")
_UP_DOWN = Trajectory("vertical", speed=1.5, size=1.0)
OTHERWISE = "fly faster, with changes of thrust, speed, heading and height"
"""What to do about a pair that is not known."""


@dataclass(frozen=True)
class Separation:
    """A pair of effects, flights that leave it a pair, and flights that separate it."""

    pair: tuple[str, str]
    """Names of the two effects."""
    words: str
    """What to do, for people."""
    blurred: tuple[Trajectory, ...]
    """Flights after which either name explains the data."""
    separating: tuple[Trajectory, ...]
    """Flights to add."""
    measure: tuple[str, ...] = ()
    """What to log besides: `motor`, `voltage`, or `scale` for a weighing."""


SEPARATIONS: tuple[Separation, ...] = (
    Separation(
        ("linear_drag", "rotor_drag"),
        "change the thrust at held speed: bob up and down quickly on a circle",
        (_SLOW_EIGHT, _CIRCLE),
        (_PUNCHES, _FAST_WOBBLE),
    ),
    Separation(
        ("linear_drag", "quadratic_drag"),
        "fly a range of speeds of at least three to one",
        (_CIRCLE, Trajectory("circle", speed=3.0, size=4.0)),
        (_RANGE, _UP_DOWN),
    ),
    Separation(
        ("quadratic_drag", "rotor_drag"),
        "fly a range of speeds of at least three to one",
        (_CIRCLE, Trajectory("circle", speed=3.0, size=4.0)),
        (_RANGE, _PUNCHES),
    ),
    Separation(
        ("inflow", "linear_drag"),
        "fly forward at speed as well as up and down",
        (_UP_DOWN, Trajectory("vertical", speed=1.0, size=1.5)),
        (_RANGE, _FAST_WOBBLE),
    ),
    Separation(
        ("command_delay", "motor_lag"),
        "fly fast chirps with yaw and log the rotor speeds",
        (_UP_DOWN, _HOVER),
        (_CHIRP, _FAST_WOBBLE),
        ("motor",),
    ),
    Separation(
        ("constant_wind", "frame_tilt"),
        "fly with at least two headings: turn on and on at speed, over a range of speeds",
        (_SLOW_EIGHT, _HOVER),
        (_SWEEP, _RANGE),
    ),
    Separation(
        ("frame_tilt", "thrust_tilt"),
        "turn the heading on and on",
        (_SLOW_EIGHT, _HOVER),
        (_SWEEP, Trajectory("hover", turn="sweep")),
    ),
    Separation(
        ("com_offset", "torque_trim"),
        "change the collective thrust: bob up and down quickly",
        (_HOVER, _SLOW_EIGHT),
        (_PUNCHES, Trajectory("vertical", speed=3.0, size=0.8)),
    ),
    Separation(
        ("com_offset", "weak_motor"),
        "turn the heading quickly: a weak rotor also twists",
        (_HOVER,),
        (_CHIRP, _FAST_WOBBLE),
    ),
    Separation(
        ("mass_offset", "thrust_scale"),
        "weigh the vehicle; failing that, fly fast turns that ask for large torques",
        (_HOVER, _UP_DOWN),
        (_CHIRP, _FAST_WOBBLE),
        ("scale",),
    ),
    Separation(
        ("inertia_scale", "rate_gain"),
        "log the rotor speeds",
        (_SLOW_EIGHT, _CIRCLE),
        (_CHIRP, _FAST_WOBBLE),
        ("motor",),
    ),
    Separation(
        ("battery_sag", "thrust_scale"),
        "fly for minutes, or log the voltage",
        (Trajectory("hover", duration_s=4.0),),
        (Trajectory("figure_eight", duration_s=60.0, speed=4.0, size=4.0),),
        ("voltage",),
    ),
)
"""Pairs that effects of a quadrotor form on gentle flights, with the way out."""


def separations_of(names: Iterable[str]) -> list[Separation]:
    """Return the known ways to split the set `names`: those whose two effects are both in it.

    Of effects that are one hypothesis each counts.
    """
    wanted = {effect for name in names for effect in effects_in(name)}
    return [entry for entry in SEPARATIONS if wanted.issuperset(entry.pair)]


def plan_for(names: Iterable[str]) -> list[Trajectory]:
    """Return the flights that split the set `names` as far as flights can, each only once.

    A set that holds no known pair gets the flights that excite most: speeds, turns and chirps.
    """
    found = [way for entry in separations_of(names) for way in entry.separating]
    return list(dict.fromkeys(found or [_RANGE, _SWEEP, _CHIRP, _FAST_WOBBLE]))


def advice(name: str, rival: str) -> str:
    """Return a line that says which flight would tell `name` from `rival`."""
    known = separations_of((name, rival))
    return f"{name} from {rival}: {known[0].words if known else OTHERWISE}"
