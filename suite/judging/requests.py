"""The options of flights of `suite eval` and `suite collect`, and how they name tracks and levels.

run.json records them. A `Manner` is a commanded speed, with the safety monitor or without.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from policies.spec import PolicyError
from suite.common.options import Advanced
from tracks.input.ranges import Range, Seed, Trials

if TYPE_CHECKING:
    from policies.policy import Policy

TimeLimit = Annotated[float, Range(0.0, 3600.0, above=True)]
"""Time limit of a trial [s], as in `eval.worlds.trial.Rules`."""

LEVELS = tuple(range(10))
"""The difficulty levels."""


@dataclass(frozen=True)
class Flights:
    """Trials on tracks with a vehicle: options of all commands that fly a policy."""

    track: str = "all"
    """zigzag, circular, ellipse, all of these, a track file (.toml), or a list with commas."""
    difficulty: str = "0,3"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Trials = 10
    """Trials of every policy on every track at every level."""
    seed: Seed = 0
    """Seed of the first trial; the others follow by one."""
    vehicle: str = "reference"
    """A shipped vehicle's name or a vehicle file (.toml)."""
    time_limit_s: Advanced[TimeLimit] = 20.0
    """A trial ends at this time [s]; a long course of your own needs more than the tables' 20."""
    trust: Advanced[bool] = False
    """Also load policy files that can run code on this machine (.pt2, .pt, .c)."""


@dataclass(frozen=True)
class SimulatedFlights(Flights):
    """Flights in a simulator that can be chosen."""

    simulator: str = "mujoco"
    """mujoco (fast on CPUs), mjx (for GPUs), reference (slow and simple), rotorpy (needs
    pip install 'diffracing-suite[rotorpy]'), or the simulator of an installed package."""
    sensors: str = "perfect"
    """Errors in what the policy sees: a shipped name (perfect, vio, stereo-depth, ...) or a sensors
    file (.toml). Recorded logs have the true state."""


@dataclass(frozen=True)
class Evaluation(SimulatedFlights):
    """Policies, trials and simulation; `suite eval` has these as options."""

    policies: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(name="policy")
    ] = ()
    """A shipped policy's name, a checkpoint's folder, or a .onnx, .pt2, .pt or .c file; may be
    given several times. Without it the policy race flies."""
    speed: Annotated[tuple[float, ...], Range(0.0, 1.0)] = ()
    """For policies with a speed input: 0 (careful) to 1 (a race); with several values all trials
    are flown at each. Without it each policy flies at its own default speed."""
    deadline_s: Advanced[Annotated[float, Range(0.0, 3600.0, above=True)] | None] = None
    """If an answer of the policy takes longer than this, the trials that wait for it (up to 128, in
    one batch) end as timed out [s]. Without it a policy may take any time."""
    monitor: Advanced[bool] = False
    """Also fly every policy a second time on the same trials, inside the safety monitor that limits
    its actions."""


@dataclass(frozen=True)
class Collection(SimulatedFlights):
    """Which flights are recorded; `suite collect` has these as options."""

    policy: str = ""
    """A shipped policy's name, a checkpoint's folder, or a policy file. Without it the policy race
    flies."""
    trials: Trials = 5
    """Flights on every track at every level."""
    speed: Annotated[float, Range(0.0, 1.0)] | None = None
    """For a policy with a speed input: 0 (careful) to 1 (a race). Without it the policy's own."""
    seed: Seed = 100_000
    """Seed of the first trial; the default is far from the seeds of suite eval."""


@dataclass(frozen=True)
class Manner:
    """Commanded speed and monitor; a call returns a policy that flies in this manner."""

    monitored: bool = False
    """Whether the safety monitor checks its actions."""
    speed: float | None = None
    """Commanded speed, 0 to 1 [1]; None: that of the policy's spec."""

    def __call__(self, policy: Policy) -> Policy:
        """Return `policy` flown in this manner.

        Raises:
            PolicyError: for a speed if the policy has no speed input.
        """
        if self.speed is not None:
            policy = _at_speed(policy, self.speed)
        if self.monitored:
            from eval.judging.monitor import Monitored

            policy = Monitored(policy)
        return policy

    def label(self, name: str) -> str:
        """Return the label of the policy `name` in this manner."""
        name += "" if self.speed is None else f"@{self.speed:g}"
        return f"{name}+monitor" if self.monitored else name


PLAIN = Manner()
"""The policy's own speed, without monitor."""


def manners(speeds: Sequence[float], monitor: bool) -> list[Manner]:
    """Return all manners: each speed, then each speed with the monitor."""
    plain = [Manner(speed=speed) for speed in speeds] or [Manner()]
    return plain + [dataclasses.replace(manner, monitored=True) for manner in plain if monitor]


def _at_speed(policy: Any, speed: float) -> Any:
    if not policy.spec.speed_input:
        raise PolicyError(
            f"--speed {speed:g}: {policy.name} takes no speed as an input; leave --speed out, or "
            "train a policy with --set spec.speed_input=True"
        )
    return dataclasses.replace(policy, spec=dataclasses.replace(policy.spec, speed=speed))


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
    names = [part.strip() for part in text.split(",")]
    for name in names:
        if not is_track_file(name):
            check_family(name)
    return list(dict.fromkeys(names))


def is_track_file(name: str) -> bool:
    """Return whether `name` is a track file and not a family."""
    return name.endswith(".toml")
