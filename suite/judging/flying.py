"""Shared by all commands that fly: loading policies, lists of trials, estimates of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.console import Console
from suite.common.stages import Estimate
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.requests import (
    PLAIN,
    Collection,
    Evaluation,
    Manner,
    is_track_file,
    parse_levels,
    parse_tracks,
)
from tracks.common.files import plain
from tracks.common.work import Workers, usable_cores, worker_count
from tracks.input.ranges import check_ranges

if TYPE_CHECKING:
    from eval.sensors.sensors_file import SensorSet
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialSpec
    from policies.policy import Policy
    from tracks.track import Track

TRIALS_A_PROCESS = 128
"""Least trials for another process, which takes seconds to start."""
GATE_MOST_M, TRACK_MOST_M = 50.0, 5000.0
"""Larger sizes cause a note: the file may be in millimetres [m]."""
SECONDS_A_TRIAL = 0.15
"""Time of one core in MuJoCo for a trial of about 13 s with 70 solids [s]."""
START_SECONDS = 6.0
"""Time to import packages and to compile the policy and the first scenes [s]."""
PROCESS_BYTES = 1.0e9
"""Memory of a process that flies 128 trials at once [bytes]."""


def default_policy() -> str:
    """Return the name of the default policy.

    Raises:
        ValueError: if no policy is shipped.
    """
    from policies import shipped

    names = shipped.names()
    if not names:
        raise ValueError("no policy is shipped with this version; give one with --policy")
    return shipped.DEFAULT if shipped.DEFAULT in names else names[0]


def checkpoint_folder(policy: str, option: str = "--policy") -> Path:
    """Return the folder of a policy that can be trained further.

    Raises:
        ValueError: if it is no checkpoint of the suite; the message has `option`.
    """
    from policies import shipped
    from policies.formats.checkpoint import CONFIG

    folder = shipped.locate(policy)
    if not (folder / CONFIG).is_file():
        names = ", ".join(shipped.names()) or "none"
        raise ValueError(
            f"{option} {policy}: only policies of this suite can be trained further; give a "
            "checkpoint's folder, such as the policy/ in the --out of suite train, or a shipped "
            f"policy's name ({names})"
        )
    return folder


def labels(policies: Sequence[str], names: Sequence[str], option: str = "--policy") -> list[str]:
    """Return each policy's label: its name, or the given path if names are equal.

    Raises:
        ValueError: if one is given twice; the message has `option`.
    """
    if len(set(policies)) < len(policies):
        twice = next(p for p in policies if list(policies).count(p) > 1)
        raise ValueError(f"{option} {twice} is given twice; give each policy once")
    return [
        given if list(names).count(name) > 1 else name
        for given, name in zip(policies, names, strict=True)
    ]


def trial_list(
    tracks: Sequence[str], levels: Sequence[int], trials: int, seed: int, once: bool = False
) -> list[TrialSpec]:
    """Return the trials of every track at every level, with the seeds seed, seed + 1, ...

    A track from a file has no levels: it is flown with every seed, or only `once`.
    """
    from eval.worlds.trial import TrialSpec

    seeds = range(seed, seed + trials)
    return [
        TrialSpec(track, level, number)
        for track in tracks
        for level in ([0] if is_track_file(track) else levels)
        for number in (seeds[:1] if once and is_track_file(track) else seeds)
    ]


class Course(NamedTuple):
    """The trials of a command, with tracks, vehicle and sensors read and checked."""

    trials: list[TrialSpec]
    """In the order of the results."""
    tracks: dict[str, Track]
    """Tracks from files, by their name in trials."""
    vehicle: Vehicle
    """The flown vehicle."""
    sensors: SensorSet
    """Errors in what policies see."""
    differences: list[str]
    """Differences between the simulator and the vehicle file, as sentences."""
    notes: list[str]
    """Other notes for the user, as sentences."""


def read_course(wanted: Evaluation | Collection, real_time: bool = False) -> Course:
    """Return the trials to fly; in `real_time` all flights differ, also without random effects.

    Raises:
        ValueError: for an unknown simulator or track, too few trials, or an invalid file.
    """
    from eval.effects import EFFECTS
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.sensors.sensors_file import load_sensors
    from eval.worlds import differences, world_class
    from eval.worlds.engine import refuse_start_contact

    world_class(wanted.simulator)
    check_ranges(wanted, options=True)
    names = parse_tracks(wanted.track)
    vehicle = load_vehicle(wanted.vehicle)
    sensors = load_sensors(wanted.sensors)
    flown_otherwise, notes = differences(wanted.simulator, vehicle), list[str]()
    levels, tracks = parse_levels(wanted.difficulty), custom_tracks(names)
    by_chance = sensors.models or any(EFFECTS[name].random for name in vehicle.effects)
    once = not (real_time or by_chance)
    if once and wanted.trials > 1:
        notes = [
            f"{name}: flown once, not {wanted.trials} times: a track from a file and a vehicle on "
            "which nothing acts by chance are the same at every seed; gusts and noise are not"
            for name in tracks
        ]
    for name, track in tracks.items():
        refuse_start_contact(name, track, vehicle)
        notes += _in_millimetres(name, track)
    trials = trial_list(names, levels, wanted.trials, wanted.seed, once)
    return Course(trials, tracks, vehicle, sensors, flown_otherwise, notes)


def _in_millimetres(name: str, track: Track) -> list[str]:
    """Return a note if the size of the gates or the track suggests a file in millimetres."""
    gates = track.scene.gates
    opening = float((gates.opening_g.max(1) - gates.opening_g.min(1)).max())
    extent = float((gates.center_w.max(0) - gates.center_w.min(0)).max())
    if opening <= GATE_MOST_M and extent <= TRACK_MOST_M:
        return []
    return [
        f"{name}: its largest gate is {opening:g} m wide and its gates lie {extent:g} m apart; is "
        "the file in millimetres? Lengths are in metres: divide them by 1000"
    ]


def log_name(track: str, difficulty: int, seed: int) -> str:
    """Return the file name of a trial's log."""
    return f"{Path(track).stem}-{difficulty}-{seed}.parquet"


def refuse_one_name(tracks: Iterable[str]) -> None:
    """Refuse tracks whose logs or pictures would have the same names."""
    stems = [Path(track).stem for track in tracks]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ValueError(
                f"--track: several tracks are called {stem!r}, and files are named after their "
                "track; rename a file, or give each its own --out"
            )


def say_notes(console: Console, world: str, course: Course) -> None:
    """Print the differences and notes of `course`."""
    differences = [f"{world}: {difference}" for difference in course.differences]
    for sentence in [*differences, *course.notes]:
        console.note(sentence)


def flying_needs(trials: float, workers: Workers, world: str = "mujoco") -> Estimate:
    """Return the approximate time and memory of `trials` in `world`.

    Raises:
        ValueError: for a cluster that cannot be used.
    """
    processes = worker_count(workers)
    seconds = START_SECONDS + trials * cost_of(world) * SECONDS_A_TRIAL / processes
    # Memory of this machine only.
    return Estimate(seconds, PROCESS_BYTES * (workers if isinstance(workers, int) else 1))


def cost_of(world: str) -> float:
    """Return the cost of a trial in `world`, relative to MuJoCo."""
    from eval.worlds import WORLDS

    return getattr(WORLDS.find(world), "cost", 1.0)


def custom_tracks(names: Sequence[str]) -> dict[str, Track]:
    """Return the tracks of those `names` that are files.

    Raises:
        ValueError: for an invalid file, with its key.
    """
    from tracks.formats.custom import load_track

    return {name: load_track(name) for name in names if is_track_file(name)}


def workers_for(trials: int, given: Workers | None, world: str) -> Workers:
    """Return the `given` workers, or as many processes as shorten the work."""
    if given is not None:
        return given
    from eval.worlds import compiles

    worth = max(1, trials // TRIALS_A_PROCESS)
    return 1 if compiles(world) else min(usable_cores(), worth)


def who_flies(
    policy: Policy, name_or_path: str, trust: bool, workers: Workers, manner: Manner = PLAIN
) -> Policy | Callable[[], Policy]:
    """Return the loaded policy, or for several processes a function that loads it.

    Processes of this machine read its files; those of a cluster get their content.

    Args:
        policy: the loaded policy, in its manner.
        name_or_path: its source.
        trust: as in `load_policy`.
        workers: of the trials.
        manner: of the flights.
    """
    if workers == 1:
        return policy
    if isinstance(workers, int):
        return partial(load_in_manner, name_or_path, trust, manner)
    return partial(_in_manner_of, PolicyContent.of(name_or_path, trust), manner)


def _in_manner_of(content: PolicyContent, manner: Manner) -> Policy:
    return manner(content())


def load_in_manner(name_or_path: str, trust: bool, manner: Manner = PLAIN) -> Policy:
    """Return a policy to fly, in its manner.

    Raises:
        PolicyError: if it cannot be loaded, or not be flown in this manner.
    """
    from policies.policy import load_policy

    return manner(load_policy(name_or_path, trust))


def about_policy(name_or_path: str, policy: Policy) -> dict[str, Any]:
    """Return name, source and digest of a policy for a result file."""
    return {
        "name": policy.name,
        "source": str(name_or_path),
        "sha256": policy_digest(str(name_or_path)),
    }


def by_content(about: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a journal or a list of flights without paths of files.

    The files' content or digest is included, so that files may be moved.
    """
    about = plain(about)
    paths = {"policy": ("source",), "collection": ("policy", "vehicle")}
    for part, keys in paths.items():
        if isinstance(about.get(part), dict):
            about[part] = {key: value for key, value in about[part].items() if key not in keys}
    return about
