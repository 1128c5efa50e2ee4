"""The trials that a command flies: tracks and levels by name, with vehicle and sensors.

`read_trial_set` reads all that the options of `suite eval`, `suite collect` and `suite fly` name.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from suite.common.vehicles import camera_warnings
from tracks.input.ranges import check_ranges

if TYPE_CHECKING:
    from eval.sensors.sensors_file import SensorSet
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialResult, TrialSpec
    from policies.spec import PolicySpec
    from suite.common.console import Console
    from suite.judging.requests import SimulatedFlights
    from tracks.track import Track

LEVELS = tuple(range(10))
"""The levels of difficulty, from easy to hard."""
NO_LEVELS = "a track from a file has no levels, so --difficulty does not change it"
"""Note if a level is given for a track from a file."""


def parse_levels(text: str) -> list[int]:
    """Return the levels of "3", "0,3,9", "0-3", "0,5-9" or "all", in the order given.

    Raises:
        ValueError: for any other text, and for a level that is not 0 to 9.
    """
    if text.strip() == "all":
        return list(LEVELS)
    levels: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d+)\s*(?:-\s*(\d+)\s*)?", part)
        if not match:
            raise ValueError(
                f"--difficulty {text!r}: {part!r} is no level; give 0 to 9, a list (0,3,9), "
                "a range (0-3), or all"
            )
        first, last = int(match[1]), int(match[2] or match[1])
        for level in (first, last):
            if level not in LEVELS:
                raise ValueError(f"--difficulty {text!r}: level {level} is not 0 to 9")
        if last < first:
            raise ValueError(f"--difficulty {text!r}: the range {part!r} runs backwards")
        levels += range(first, last + 1)
    return list(dict.fromkeys(levels))


def parse_tracks(text: str) -> list[str]:
    """Return the tracks of "all" (the judged families), a name, a file, or a list of them.

    A name that ends in ``.toml`` is a track file; others are families.

    Raises:
        ValueError: for an unknown family, with the most similar one.
    """
    from tracks.families import JUDGED, check_family

    if text.strip() == "all":
        return list(JUDGED)
    tracks: dict[str, str] = {}
    for name in map(str.strip, text.split(",")):
        if not is_track_file(name):
            check_family(name)
        # Two paths of one file are one track, which has the first of these names.
        tracks.setdefault(os.path.realpath(name) if is_track_file(name) else name, name)
    return list(tracks.values())


def is_track_file(name: str) -> bool:
    """Return whether `name` is a track file and not a family."""
    return name.endswith(".toml")


def trial_list(
    tracks: Sequence[str],
    levels: Sequence[int],
    trials: int,
    seed: int,
    once: Collection[str] = (),
) -> list[TrialSpec]:
    """Return the trials of every track at every level, with the seeds seed, seed + 1, ...

    A track from a file has no levels. The tracks in `once` are flown with the first seed only.
    """
    from eval.worlds.trial import TrialSpec

    seeds = range(seed, seed + trials)
    return [
        TrialSpec(track, level, number)
        for track in tracks
        for level in ([0] if is_track_file(track) else levels)
        for number in (seeds[:1] if track in once else seeds)
    ]


class TrialSet(NamedTuple):
    """The trials of a command, with tracks, vehicle and sensors read and checked."""

    trials: list[TrialSpec]
    """The trials, in the order of the results."""
    tracks: dict[str, Track]
    """Tracks from files, by their name in the trials."""
    vehicle: Vehicle
    """The flown vehicle."""
    sensors: SensorSet
    """Sensor errors in what policies see."""
    differences: list[str]
    """Differences between the simulator and the vehicle file, as sentences."""
    notes: list[str]
    """Other notes for the user, as sentences."""


def read_trial_set(
    options: SimulatedFlights,
    repeated: bool = False,
    track: Track | None = None,
    vehicle: Vehicle | None = None,
) -> TrialSet:
    """Return the trials that a command's options describe.

    A track from a file is flown only once if all its flights would be equal. No two flights are
    equal in real time, or with a random policy: then it is `repeated`. `track` and `vehicle` fly
    instead of those that `options` name.

    Raises:
        ValueError: for an unknown simulator or track, too few trials, or an invalid file.
    """
    from eval.effects import EFFECTS, without_signal
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.sensors import SENSORS
    from eval.sensors.sensors_file import load_sensors
    from eval.worlds import differences, world_class
    from eval.worlds.engine import course_notes, family_notes
    from tracks.formats.custom import load_track

    world_class(options.simulator)
    check_ranges(options, options=True)
    vehicle = vehicle or load_vehicle(options.vehicle)
    sensors = load_sensors(options.sensors)
    if track is None:
        names, levels = parse_tracks(options.track), parse_levels(options.difficulty)
        tracks = {name: load_track(name) for name in names if is_track_file(name)}
    else:
        names, levels = [track_name(track)], [track.level]
        tracks = {names[0]: track}
    notes = without_signal(vehicle)
    # Without random effects every seed would give the same flight on a track from a file.
    is_random = sensors.random or any(EFFECTS[name].random for name in vehicle.effects)
    once = () if repeated or is_random else tracks.keys()
    if options.trials > 1:
        notes += [
            f"{name}: flown once, not {options.trials} times: without random effects (gusts, "
            "noise) all flights on one track are equal"
            for name in once
        ]
    notes += [
        f"sensors {sensors.name!r}: {name} has no effect, because the sizes of all its errors are "
        f"zero or left out; give one, such as {SENSORS[name].grows[0]!r}"
        for name in sensors.without_effect
    ]
    if not sensors.models and sensors.name != "perfect":
        notes.append(f"sensors {sensors.name!r}: no sensor model is in the file, so all is exact")
    if sensors.estimator is None and any(SENSORS[name].measure for name in sensors.models):
        notes.append(
            f"sensors {sensors.name!r}: the IMU has no effect, because only an estimator "
            "(gate_filter) uses it"
        )
    if levels != [0] and options.difficulty != type(options).difficulty:
        notes += [f"{name}: {NO_LEVELS}" for name in tracks]
    for name, custom in tracks.items():
        notes += course_notes(name, custom, vehicle)
    for name in (name for name in names if name not in tracks):
        notes += family_notes(name, levels[0], options.seed, vehicle)
    trials = trial_list(names, levels, options.trials, options.seed, once)
    simulator_differences = differences(options.simulator, vehicle)
    return TrialSet(trials, tracks, vehicle, sensors, simulator_differences, notes)


def track_name(track: Track) -> str:
    """Return the name of a track object in results.

    It is the object's own name, but not that of a family: by it a trial would be one of the
    family's tracks with the trial's seed.
    """
    from tracks.families import FAMILIES

    if track.family not in FAMILIES:
        return track.family
    return f"{track.family}-{track.level}-{track.seed}"


def equal_flights(results: Sequence[TrialResult], tracks: Collection[str]) -> list[str]:
    """Return a note for each of `tracks` on which all of several flights are the same."""
    notes = []
    for name in tracks:
        flights = [result._replace(seed=0) for result in results if result.track == name]
        if len(flights) > 1 and len(set(flights)) == 1:
            notes.append(
                f"{name}: {len(flights)} equal flights, as nothing in them is random; they count "
                "as one trial"
            )
    return notes


def log_name(track: str, difficulty: int, seed: int) -> str:
    """Return the file name of a trial's log."""
    return f"{Path(track).stem}-{difficulty}-{seed}.parquet"


def refuse_equal_names(tracks: Iterable[str]) -> None:
    """Refuse tracks whose logs or pictures would have the same names.

    Raises:
        ValueError: naming the tracks' common name.
    """
    stems = [Path(track).stem for track in tracks]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ValueError(
                f"--track: several tracks are called {stem!r}, and files are named after their "
                "track; rename a track file, or fly each track with another --out"
            )


def show_notes(
    console: Console, simulator: str, trial_set: TrialSet, specs: Iterable[PolicySpec]
) -> None:
    """Print the differences and notes of `trial_set`, which policies with these `specs` fly."""
    cameras = [
        f"warning: {warning}"
        for camera in dict.fromkeys(spec.camera for spec in specs)
        for warning in camera_warnings(camera, trial_set.vehicle)
    ]
    differences = [f"{simulator}: {difference}" for difference in trial_set.differences]
    for sentence in [*cameras, *differences, *trial_set.notes]:
        console.note(sentence)
