"""Load the policies that commands fly, and choose the number of processes that fly them.

A manner is how a policy flies: at a commanded speed, with the safety monitor around it or without.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from policies import shipped
from policies.formats.checkpoint import CONFIG
from policies.policy import Policy
from policies.spec import PolicyError
from suite.common.stages import Estimate
from suite.judging.content import PolicyContent
from suite.judging.requests import SimulatedFlights
from suite.judging.trials import TrialSet
from tracks.common.files import plain
from tracks.common.names import unknown_name
from tracks.common.work import Workers, usable_cores, worker_count

if TYPE_CHECKING:
    from eval.judging.judge import OnResult, Record
    from eval.worlds.trial import TrialResult, TrialSpec

TRIALS_A_PROCESS = 128
"""Smallest number of trials for another process: the start of a process takes seconds."""
SECONDS_A_TRIAL = 0.15
"""Time that one core needs in MuJoCo for a trial of about 13 s on a track with 70 solids [s]."""
START_SECONDS = 6.0
"""Time to import packages and to compile the policy and the first tracks [s]."""
PROCESS_BYTES = 1.0e9
"""Memory of a process that flies 128 trials at once [bytes]."""


@dataclass(frozen=True)
class Manner:
    """How a policy flies; a call returns a policy that flies in this manner."""

    monitored: bool = False
    """Whether the safety monitor checks the policy's actions."""
    speed: float | None = None
    """Commanded speed, 0 to 1; None: that of the policy's spec."""

    def __call__(self, policy: Policy) -> Policy:
        """Return `policy` flown in this manner.

        Raises:
            PolicyError: for a speed if the policy has no speed input.
        """
        if self.speed is not None:
            if not policy.spec.speed_input:
                raise PolicyError(
                    f"--speed {self.speed:g}: {policy.name} takes no speed as an input; leave "
                    "--speed out, or train a policy with --set spec.speed_input=True"
                )
            spec = dataclasses.replace(policy.spec, speed=self.speed)
            policy = dataclasses.replace(cast(Any, policy), spec=spec)
        if self.monitored:
            from eval.judging.monitor import Monitored

            policy = Monitored(policy)
        return policy

    def label(self, name: str) -> str:
        """Return the label of the policy `name` in this manner."""
        name += "" if self.speed is None else f"@{self.speed:g}"
        return f"{name}+monitor" if self.monitored else name


PLAIN = Manner()
"""The manner without options: the speed of the policy's spec, without monitor."""


def manners(speeds: Sequence[float], monitor: bool) -> list[Manner]:
    """Return all manners: each speed without the monitor, then each speed with it if `monitor`."""
    unmonitored = [Manner(speed=speed) for speed in speeds] or [Manner()]
    return unmonitored + [
        dataclasses.replace(manner, monitored=True) for manner in unmonitored if monitor
    ]


def default_policy() -> str:
    """Return the name of the default policy.

    Raises:
        ValueError: if no policy is shipped.
    """
    names = shipped.names()
    if not names:
        raise ValueError("no policy is shipped with this version; give one with --policy")
    return shipped.DEFAULT if shipped.DEFAULT in names else names[0]


def checkpoint_folder(policy: str, option: str = "--policy") -> Path:
    """Return the folder of a policy's checkpoint, from which it can be trained further.

    Raises:
        ValueError: if the policy is not a checkpoint of the suite; the message names `option`.
    """
    folder = shipped.locate(policy)
    if not folder.exists():
        raise ValueError(
            f"{unknown_name(option, policy, shipped.names())} Or give a checkpoint's folder, such "
            "as the policy/ in the --out of suite train"
        )
    if (folder / "policy" / CONFIG).is_file():
        raise ValueError(
            f"{option} {policy} is the folder of a training; give its policy, {folder / 'policy'}"
        )
    if not (folder / CONFIG).is_file():
        names = ", ".join(shipped.names()) or "none"
        raise ValueError(
            f"{option} {policy}: only policies of this suite can be trained further; give a "
            "checkpoint's folder, such as the policy/ in the --out of suite train, or a shipped "
            f"policy's name ({names})"
        )
    return folder


def policy_labels(sources: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return each policy's label: its name, or its source if several policies have that name.

    The user gave the `sources`; `names` are those of the loaded policies.

    Raises:
        ValueError: if a source is given twice.
    """
    if len(set(sources)) < len(sources):
        repeated = next(source for source in sources if list(sources).count(source) > 1)
        raise ValueError(f"--policy {repeated} is given twice; give each policy once")
    return [
        source if list(names).count(name) > 1 else name
        for source, name in zip(sources, names, strict=True)
    ]


def flying_estimate(trials: float, workers: Workers, simulator: str = "mujoco") -> Estimate:
    """Return the approximate time and memory of a number of trials in `simulator`.

    Raises:
        ValueError: for a cluster that cannot be used.
    """
    processes = worker_count(workers)
    seconds = START_SECONDS + trials * relative_cost(simulator) * SECONDS_A_TRIAL / processes
    # The memory is that on this machine; a cluster has its own.
    return Estimate(seconds, PROCESS_BYTES * (workers if isinstance(workers, int) else 1))


def relative_cost(simulator: str) -> float:
    """Return the time of a trial in `simulator`, relative to MuJoCo."""
    from eval.worlds import WORLDS

    return getattr(WORLDS.find(simulator), "cost", 1.0)


def workers_for(trials: int, workers: Workers | None, simulator: str) -> Workers:
    """Return `workers`; for None, the number of processes that makes `trials` flights fastest.

    It is 1 in a simulator that compiles for each number of trials, as every process would compile.
    """
    if workers is not None:
        return workers
    from eval.worlds import compiles

    worthwhile = max(1, trials // TRIALS_A_PROCESS)
    return 1 if compiles(simulator) else min(usable_cores(), worthwhile)


def policy_for_workers(
    policy: Policy, content: PolicyContent, workers: Workers, manner: Manner = PLAIN
) -> Policy | Callable[[], Policy]:
    """Return the loaded policy, or for several processes a function that loads its `content`.

    They do not read its files, which a training may replace while they fly.
    """
    return policy if workers == 1 else partial(_load_content, content, manner)


def _load_content(content: PolicyContent, manner: Manner) -> Policy:
    """Return a policy from the content of its files, in its manner."""
    return manner(content())


def load_in_manner(name_or_path: str, trust: bool, manner: Manner = PLAIN) -> Policy:
    """Return a policy to fly, in its manner.

    Raises:
        PolicyError: if the policy cannot be loaded, or cannot fly in this manner.
    """
    from policies.policy import load_policy

    return manner(load_policy(name_or_path, trust))


def fly_trials(
    policy: Policy | Callable[[], Policy],
    request: SimulatedFlights,
    trial_set: TrialSet,
    workers: Workers = 1,
    trials: Sequence[TrialSpec] | None = None,
    on_result: OnResult | None = None,
    record: Record | None = None,
) -> list[TrialResult]:
    """Fly a command's trials in the judge, with the settings of its `request`.

    They are all of `trial_set`, or else `trials`; the other arguments are those of
    `eval.judging.judge.fly`.
    """
    from eval.judging.guard import ActionLimits
    from eval.judging.judge import JudgeOptions, fly
    from eval.worlds.trial import Rules

    options = JudgeOptions(
        workers=workers,
        rules=Rules(time_limit_s=request.time_limit_s),
        limits=ActionLimits(deadline_s=getattr(request, "deadline_s", None)),
        sensors=trial_set.sensors,
    )
    trials = trial_set.trials if trials is None else trials
    return fly(
        policy, trials, trial_set.vehicle, request.simulator, options, on_result, record,
        trial_set.tracks,
    )  # fmt: skip


def fly_from_python(
    policy: Policy,
    content: PolicyContent | None,
    request: SimulatedFlights,
    trial_set: TrialSet,
    processes: int,
) -> list[TrialResult]:
    """Fly all trials for a program, in this process or in several that import the program again.

    `content` are the files of a policy that the program gave by name or path, None for an object.

    Raises:
        ValueError: for an object that cannot be sent to other processes, or of a class that they
            lack.
        WorkerDied: where they cannot import the program, or died twice with the same trials.
    """
    from tracks.common.work.pickling import WorkerDied, pack

    if processes == 1:
        return fly_trials(policy, request, trial_set)
    flown: Policy | Callable[[], Policy] = policy
    if content is not None:
        flown = policy_for_workers(policy, content, processes)
    try:
        pack(flown)
    except ValueError as error:
        raise ValueError(
            f"policy {policy.name!r} cannot be sent to other processes; give its name or path "
            "instead of the object, or leave workers out"
        ) from error
    guard = '`if __name__ == "__main__":`'
    try:
        return fly_trials(flown, request, trial_set, processes)
    except AttributeError as error:
        if "__mp_main__" not in str(error) and "__main__" not in str(error):
            raise
        raise ValueError(
            f"another process lacks what this program defines ({error}); define it in a module or "
            f"above {guard}, or leave workers out, as in a notebook"
        ) from error
    except WorkerDied as error:
        raise WorkerDied(
            f"{error} With exit code 1 it could not import this program: call evaluate_policy "
            f"below {guard}."
        ) from error


def policy_record(source: str, policy: Policy, content: PolicyContent) -> dict[str, Any]:
    """Return name, source (name or path), and SHA-256 of files and settings, for a result file."""
    return {
        "name": policy.name,
        "source": source,
        "sha256": content.digest,
        "settings_sha256": content.settings_digest,
    }


def without_paths(settings: dict[str, Any]) -> dict[str, Any]:
    """Return the settings of a journal or a list of flights without paths of files.

    They have the content or the SHA-256 of the files instead, so that files may be moved.
    """
    settings = plain(settings)
    paths = {"policy": ("source",), "collection": ("policy", "vehicle", "sensors")}
    for part, keys in paths.items():
        if isinstance(settings.get(part), dict):
            entries = settings[part].items()
            settings[part] = {key: value for key, value in entries if key not in keys}
    return settings
