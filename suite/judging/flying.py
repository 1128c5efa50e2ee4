"""What the commands that fly have in common: who flies, which trials, on what."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from suite.common.choices import is_track_file, parse_levels, parse_tracks
from suite.common.console import Console
from suite.common.estimate import Estimate
from suite.judging.requests import Collection, Evaluation
from tracks.common.work import usable_cores
from tracks.input.ranges import check_ranges

if TYPE_CHECKING:
    from eval.judging.judge import JudgeOptions
    from eval.vehicles.vehicle import Vehicle
    from eval.worlds.trial import TrialSpec
    from policies.policy import Policy
    from tracks.track import Track

TRIALS_A_PROCESS = 128
"""Fewer trials than this are not worth another process, which takes seconds to start."""
SECONDS_A_TRIAL = 0.15
"""Of one core in MuJoCo, for a trial of about 13 s on 70 solids."""
START_SECONDS = 6.0
"""To import, compile the policy and the first scenes."""
PROCESS_BYTES = 1.0e9
"""Memory of one process that flies 64 trials at once."""


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


def policy_digest(name_or_path: str) -> str:
    """Return the SHA-256 of a policy's files, or of what flies of its folder, as hex.

    A card or a curve beside it may change and the policy be the same.
    """
    from policies import shipped
    from policies.formats.checkpoint import CONFIG, WEIGHTS

    path = shipped.locate(name_or_path)
    files = [path]
    if path.is_dir():
        names = (CONFIG, WEIGHTS) if (path / CONFIG).exists() else ("policy.h", "policy.c")
        files = [path / name for name in names if (path / name).is_file()]
    elif path.suffix == ".c":
        files = [path.with_name("policy.h"), path]
    elif path.suffix == ".onnx":
        from policies.formats.onnx_file import files_of

        files = files_of(path)
    digest = hashlib.sha256()
    for file in files:
        digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


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


def labels(policies: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return what tables call each policy: its name, or what was asked for where names clash."""
    if len(set(policies)) < len(policies):
        twice = next(p for p in policies if list(policies).count(p) > 1)
        raise ValueError(f"--policy {twice} is given twice; give each policy once")
    return [
        asked if list(names).count(name) > 1 else name
        for asked, name in zip(policies, names, strict=True)
    ]


def trial_list(
    tracks: Sequence[str], levels: Sequence[int], trials: int, seed: int
) -> list[TrialSpec]:
    """Return the trials of every track at every level, with the seeds seed, seed + 1, ...

    A track from a file has no levels: it is flown once a seed.
    """
    from eval.worlds.trial import TrialSpec

    seeds = range(seed, seed + trials)
    return [
        TrialSpec(track, level, number)
        for track in tracks
        for level in ([0] if is_track_file(track) else levels)
        for number in seeds
    ]


class Course(NamedTuple):
    """What a command is asked to fly, read and checked."""

    trials: list[TrialSpec]
    """In the order of the rows of results."""
    tracks: dict[str, Track]
    """Those that come from files, by the name that trials call them."""
    vehicle: Vehicle
    """On what."""
    differences: list[str]
    """What of the vehicle the world flies otherwise, in sentences."""


def read_course(wanted: Evaluation | Collection) -> Course:
    """Return what is to be flown.

    Raises:
        ValueError: for an unknown world or track, too few trials, or a bad track or vehicle file.
    """
    from eval.quadrotor.vehicle_file import load_vehicle
    from eval.worlds import differences, world_class

    world_class(wanted.world)
    check_ranges(wanted, options=True)
    names = parse_tracks(wanted.track)
    trials = trial_list(names, parse_levels(wanted.difficulty), wanted.trials, wanted.seed)
    vehicle = load_vehicle(wanted.vehicle)
    flown_otherwise = differences(wanted.world, vehicle)
    return Course(trials, custom_tracks(names), vehicle, flown_otherwise)


def say_differences(console: Console, world: str, course: Course) -> None:
    """Tell a person what of the vehicle `world` flies otherwise than its file says."""
    for sentence in course.differences:
        console.note(f"{world}: {sentence}")


def flying_needs(trials: float, processes: int, world: str = "mujoco") -> Estimate:
    """Return about how long `trials` take in `world`, and their memory."""
    seconds = START_SECONDS + trials * cost_of(world) * SECONDS_A_TRIAL / processes
    return Estimate(seconds, processes * PROCESS_BYTES)


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


def options_for(trials: int, processes: int | None, world: str) -> JudgeOptions:
    """Return how `trials` are flown; `processes` None takes what is worth it."""
    from eval.judging.judge import JudgeOptions

    if processes is None:
        worth = max(1, trials // TRIALS_A_PROCESS)
        processes = 1 if world == "mjx" else min(usable_cores(), worth)
    return JudgeOptions(processes=processes)


def who_flies(
    policy: Policy, name_or_path: str, trust: bool, processes: int | None
) -> Policy | Callable[[], Policy]:
    """Return the loaded policy, or for several processes how each of them loads its own."""
    from eval.judging.monitor import Monitored

    monitored = isinstance(policy, Monitored)
    return policy if processes == 1 else partial(load_flier, name_or_path, trust, monitored)


def load_flier(name_or_path: str, trust: bool, monitored: bool) -> Policy:
    """Return a policy to fly, with the safety monitor around it where it is asked for.

    Raises:
        PolicyError: where it cannot be loaded.
    """
    from eval.judging.monitor import Monitored
    from policies.policy import load_policy

    policy = load_policy(name_or_path, trust)
    return Monitored(policy) if monitored else policy


def about_policy(name_or_path: str, policy: Policy) -> dict[str, Any]:
    """Return what a result file says of a policy: name, source and digest."""
    return {
        "name": policy.name,
        "source": str(name_or_path),
        "sha256": policy_digest(str(name_or_path)),
    }
