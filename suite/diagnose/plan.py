"""Plans flights that separate effects which the diagnosed flights do not.

Two effects are separated if only one of them explains the flights. Each planned flight is a
trajectory. Its parameters are in `plan.json`, and its set points in a CSV for autopilots: position,
velocity, acceleration and yaw at every hundredth of a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from eval.flights.trajectory import Trajectory
from suite.diagnose.estimate.parameters import effects_in
from tracks.common.files import write_json, write_text
from tracks.common.provenance import stamp
from tracks.input.reading import read_json

RATE_HZ = 100.0
"""Rate of the set points [Hz]."""
MEASURES = {
    "motor": "Log the rotor speeds as well.",
    "voltage": "Log the battery's voltage as well.",
    "scale": "Better still: weigh the vehicle.",
}
"""Advice on further measurements, by their names in `Separation.measure`."""
SCHEMA = 1
"""Version of plan.json."""
COLUMNS = ("time", *(f"{stem}_{axis}" for stem in ("pos", "vel", "acc") for axis in "xyz"), "yaw")
"""Columns of a CSV: time [s]; world position [m], velocity [m/s], acceleration [m/s^2]; yaw
[rad]."""
NAME = "plan.json"
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
"""Advice for effects without an entry in `SEPARATIONS`."""


def trajectories_for(result: Mapping[str, Any]) -> tuple[list[Trajectory], list[str]]:
    """Return the flights that separate effects from their alternatives, and advice in words."""
    trajectories, words = list[Trajectory](), list[str]()
    for effect in result["effects"]:
        if effect["alternatives"]:
            names = {effect["name"], *effect["alternatives"]}
            trajectories += plan_for(names)
            words += [advice(effect["name"], rival) for rival in effect["alternatives"]]
            words += [MEASURES[key] for entry in separations_of(names) for key in entry.measure]
    # Each trajectory is flown twice, so that one flight can be held out; the second is rotated
    # about z by 2.1 rad.
    flights = [
        flight
        for trajectory in dict.fromkeys(trajectories)
        for flight in (trajectory, replace(trajectory, direction=2.1))
    ]
    return flights, list(dict.fromkeys(words))


def remove_plan(folder: Path) -> None:
    """Remove an earlier plan.json in `folder` and the files that it lists, but no other files."""
    path = folder / NAME
    if not path.is_file():
        return
    try:
        listed = [flight.get("file") for flight in read_json(path)["flights"]]
    except (ValueError, KeyError, TypeError, AttributeError):
        return  # another program's file, which will be overwritten
    for name in listed:
        # A name that leads out of the folder is not one that this command wrote.
        if isinstance(name, str) and (folder / name).resolve().is_relative_to(folder.resolve()):
            (folder / name).unlink(missing_ok=True)
    path.unlink()


def write_plan(folder: Path, ways: Sequence[Trajectory], words: Sequence[str]) -> dict[str, Any]:
    """Write plan.json and the set points of each flight into `folder`; without flights, nothing.

    An earlier plan in it is removed. Returned is the content of plan.json, with the advice `words`.
    """
    remove_plan(folder)
    if not ways:
        return {"flights": [], "words": ["No effects are left to separate: no flight is planned."]}
    folder.mkdir(parents=True, exist_ok=True)
    flights = []
    for number, way in enumerate(ways, 1):
        name = f"{number}_{way.kind}.csv"
        time_s = np.arange(0.0, way.duration_s + 0.5 / RATE_HZ, 1.0 / RATE_HZ)
        wanted = way.reference(time_s)
        table = np.column_stack([time_s, wanted.pos_w, wanted.vel_w, wanted.acc_w, wanted.yaw])
        rows = [",".join(COLUMNS), *(",".join(f"{v:.6g}" for v in row) for row in table)]
        write_text(folder / name, "\n".join(rows) + "\n")
        flights.append(
            {
                "file": name,
                "trajectory": asdict(way),
                "room": np.ptp(wanted.pos_w, axis=0).tolist(),
                "top_speed": float(np.linalg.norm(wanted.vel_w, axis=1).max()),
                "top_acceleration": float(np.linalg.norm(wanted.acc_w, axis=1).max()),
            }
        )
    plan = {"flights": flights, "words": list(words)}
    write_json(folder / NAME, {**plan, **stamp(SCHEMA, None)})
    return plan


@dataclass(frozen=True)
class Separation:
    """The names of two effects, advice for people, and flights that separate them or do not."""

    pair: tuple[str, str]
    """Names of the two effects."""
    words: str
    """Advice for people."""
    blurred: tuple[Trajectory, ...]
    """Flights on which either effect explains the data."""
    separating: tuple[Trajectory, ...]
    """Further flights that separate them."""
    measure: tuple[str, ...] = ()
    """Further measurements that do: `motor` (rotor speeds), `voltage` or `scale` (weighing)."""


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
        "fly with at least two headings: keep yawing at speed, over a range of speeds",
        (_SLOW_EIGHT, _HOVER),
        (_SWEEP, _RANGE),
    ),
    Separation(
        ("frame_tilt", "thrust_tilt"),
        "keep yawing",
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
"""Pairs of effects that slow flights do not separate, and flights that do."""


def separations_of(names: Iterable[str]) -> list[Separation]:
    """Return the entries of `SEPARATIONS` for the effects in `names`, some of them composites."""
    wanted = {effect for name in names for effect in effects_in(name)}
    return [entry for entry in SEPARATIONS if wanted.issuperset(entry.pair)]


def plan_for(names: Iterable[str]) -> list[Trajectory]:
    """Return the trajectories that separate the effects `names`, or else the fastest ones."""
    separating = [way for entry in separations_of(names) for way in entry.separating]
    return list(dict.fromkeys(separating or [_RANGE, _SWEEP, _CHIRP, _FAST_WOBBLE]))


def advice(name: str, rival: str) -> str:
    """Return a line for people: how to fly to separate the effect `name` from a `rival`."""
    entries = separations_of((name, rival))
    return f"{name} from {rival}: {entries[0].words if entries else OTHERWISE}"
