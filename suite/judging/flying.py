"""What the commands that fly have in common: who flies, which trials, on what."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.choices import is_track_file, parse_levels, parse_tracks
from suite.common.console import Console
from suite.common.stages import Estimate
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.requests import PLAIN, Collection, Evaluation, Manner
from tracks.common.files import plain
from tracks.common.work import Workers, crew, usable_cores
from tracks.input.ranges import check_ranges

if TYPE_CHECKING:
    from eval.sensors.sensors_file import SensorSet
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialSpec
    from policies.policy import Policy
    from tracks.track import Track

TRIALS_A_PROCESS = 128
"""Fewer trials than this are not worth another process, which takes seconds to start."""
GATE_MOST_M, TRACK_MOST_M = 50.0, 5000.0
"""Larger ones are asked about: a file in millimetres is a thousand times as large [m]."""
SECONDS_A_TRIAL = 0.15
"""Of one core in MuJoCo, for a trial of about 13 s on 70 solids."""
START_SECONDS = 6.0
"""To import, compile the policy and the first scenes."""
PROCESS_BYTES = 1.0e9
"""Memory of one process that flies 128 trials at once."""


def default_policy() -> str:
    """Return the name of the policy that flies when none is given.

    Raises:
        ValueError: where no policy is shipped.
    """
    from policies import shipped

    names = shipped.names()
    if not names:
        raise ValueError("no policy is shipped with this version; give one with --policy")
    return shipped.DEFAULT if shipped.DEFAULT in names else names[0]


def checkpoint_folder(policy: str, option: str = "--policy") -> Path:
    """Return the folder of a policy that can be trained on.

    Raises:
        ValueError: where it is not one of our checkpoints; `option` is named.
    """
    from policies import shipped
    from policies.formats.checkpoint import CONFIG

    folder = shipped.locate(policy)
    if not (folder / CONFIG).is_file():
        names = ", ".join(shipped.names()) or "none"
        raise ValueError(
            f"{option} {policy}: training goes on from what was trained here and needs a "
            "checkpoint's folder, such as the policy/ in the --out of suite train, or a shipped "
            f"policy's name ({names})"
        )
    return folder


def labels(policies: Sequence[str], names: Sequence[str], option: str = "--policy") -> list[str]:
    """Return what tables call each policy: its name, or what was given where names clash.

    Raises:
        ValueError: where one is given twice; `option` is named.
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

    A track from a file has no levels: it is flown once a seed, or `once` in all.
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
    """What a command flies, read and checked."""

    trials: list[TrialSpec]
    """In the order of the rows of results."""
    tracks: dict[str, Track]
    """Those that come from files, by the name that trials call them."""
    vehicle: Vehicle
    """On what."""
    sensors: SensorSet
    """Through which sensors."""
    differences: list[str]
    """What of the vehicle the world flies otherwise, in sentences."""
    notes: list[str]
    """What else is printed, in sentences."""


def read_course(wanted: Evaluation | Collection, real_time: bool = False) -> Course:
    """Return what is to be flown; in `real_time` no two flights are alike, whatever acts.

    Raises:
        ValueError: for an unknown world or track, too few trials, or a bad track or vehicle file.
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
    """Return a question where gates or the whole track are of no size that is flown in metres."""
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
    """Return what the log of a trial is called."""
    return f"{Path(track).stem}-{difficulty}-{seed}.parquet"


def refuse_one_name(tracks: Iterable[str]) -> None:
    """Refuse tracks whose logs or pictures would be written over each other."""
    stems = [Path(track).stem for track in tracks]
    for stem in stems:
        if stems.count(stem) > 1:
            raise ValueError(
                f"--track: more than one is called {stem!r}, and what is written is named after "
                "its track; rename a file, or give each an --out of its own"
            )


def say_notes(console: Console, world: str, course: Course) -> None:
    """Print what of `course` differs from the request."""
    differences = [f"{world}: {difference}" for difference in course.differences]
    for sentence in [*differences, *course.notes]:
        console.note(sentence)


def flying_needs(trials: float, workers: Workers, world: str = "mujoco") -> Estimate:
    """Return about how long `trials` take in `world`, and their memory.

    Raises:
        ValueError: where `workers` is a cluster that cannot work for us.
    """
    processes = crew(workers)
    seconds = START_SECONDS + trials * cost_of(world) * SECONDS_A_TRIAL / processes
    # Of this machine: a cluster's is not ours to count.
    return Estimate(seconds, PROCESS_BYTES * (workers if isinstance(workers, int) else 1))


def cost_of(world: str) -> float:
    """Return what a trial in `world` costs over one in MuJoCo."""
    from eval.worlds import WORLDS

    return getattr(WORLDS.find(world), "cost", 1.0)


def custom_tracks(names: Sequence[str]) -> dict[str, Track]:
    """Return the tracks of those `names` that are files.

    Raises:
        ValueError: for a bad file, with its key.
    """
    from tracks.formats.custom import load_track

    return {name: load_track(name) for name in names if is_track_file(name)}


def workers_for(trials: int, given: Workers | None, world: str) -> Workers:
    """Return who flies `trials` where `given` workers were named; None takes what is worth it."""
    if given is not None:
        return given
    from eval.worlds import compiles

    worth = max(1, trials // TRIALS_A_PROCESS)
    return 1 if compiles(world) else min(usable_cores(), worth)


def who_flies(
    policy: Policy, name_or_path: str, trust: bool, workers: Workers, manner: Manner = PLAIN
) -> Policy | Callable[[], Policy]:
    """Return the loaded policy, or for several processes how each of them loads its own.

    Those of this machine read it where it is, those of a cluster are given its content.

    Args:
        policy: as it was loaded, in its manner.
        name_or_path: where from.
        trust: as `load_policy` has it.
        workers: who shares the trials.
        manner: in which it flies.
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
        PolicyError: where it cannot be loaded, or not be flown so.
    """
    from policies.policy import load_policy

    return manner(load_policy(name_or_path, trust))


def about_policy(name_or_path: str, policy: Policy) -> dict[str, Any]:
    """Return what a result file says of a policy: name, source and digest."""
    return {
        "name": policy.name,
        "source": str(name_or_path),
        "sha256": policy_digest(str(name_or_path)),
    }


def by_content(about: dict[str, Any]) -> dict[str, Any]:
    """Return what a journal or a list of flights is about, without where its files lay.

    Their content is there as a digest or as it was read, so that a moved folder changes nothing.
    """
    about = plain(about)
    paths = {"policy": ("source",), "collection": ("policy", "vehicle")}
    for part, keys in paths.items():
        if isinstance(about.get(part), dict):
            about[part] = {key: value for key, value in about[part].items() if key not in keys}
    return about
