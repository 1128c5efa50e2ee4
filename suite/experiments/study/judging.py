"""Judge trials with a permanent cache of results: each flight is flown only once.

The results of a setup (policy, vehicle, sensors, simulator) are in one file of the cache, its
journal. Its name is the SHA-256 of everything else that determines an outcome: the setup, the code
of the judge and the versions of the packages. A result is written as soon as its trial ends. All
pages share the journals.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any, TypeVar

from eval.judging.judge import MOST_A_PIECE, JudgeOptions, Task, fly_share
from eval.judging.results import Journal
from eval.sensors.sensors_file import PERFECT, SensorSet
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import Policy, load_policy
from policies.spec import NeedsTrust, PolicyError
from suite.common.console import Console, counted
from suite.common.provenance import engines
from suite.common.stages import announce
from suite.experiments.study.cache import FLIES, Workspace, code_digest, digest
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.flying import (
    default_policy,
    flying_estimate,
    policy_labels,
    relative_cost,
    workers_for,
)
from suite.judging.trials import parse_levels, trial_list
from tracks.common.work import run_pieces, worker_count
from tracks.families import JUDGED

Key = TypeVar("Key", bound=Hashable)
"""Type of the keys of requests."""


@dataclass(frozen=True)
class TrialRequest:
    """Trials, and the setup (all but the trial) that determines their outcome."""

    policy: str
    """A shipped policy's name, a checkpoint's folder, or a policy file."""
    vehicle: Vehicle
    """The vehicle that the policy flies."""
    trials: Sequence[TrialSpec]
    """Track, level and seed of each trial."""
    sensors: SensorSet = PERFECT
    """Errors in what the policy sees."""
    simulator: str = "mujoco"
    """A name of `suite list simulators`."""


def fly_trials(
    requests: Mapping[Key, TrialRequest], workspace: Workspace, console: Console, title: str
) -> dict[Key, list[TrialResult]]:
    """Return the results of every request; trials that are not in the cache are flown first.

    After an interrupt, finished trials stay in the cache. Several requests may have the same setup.
    Without workers, as many processes of this machine are started as shorten the work.

    Raises:
        ValueError: for a policy that cannot be loaded, before the first flight.
    """
    # 1. Find the journal of each request. Requests with the same setup share one.
    policies = {request.policy: PolicyContent.of(request.policy) for request in requests.values()}
    names: dict[Key, str] = {}
    setups: dict[str, TrialRequest] = {}
    inputs: dict[str, dict[str, Any]] = {}
    for key, request in requests.items():
        # Everything except the trial that determines the outcome of a flight.
        entry = {
            "policy_sha256": policies[request.policy].digest,
            "vehicle": request.vehicle,
            "sensors": request.sensors,
            "world": request.simulator,
            "code": code_digest(*FLIES),
            "engines": engines(),
        }
        names[key] = name = digest(entry)
        earlier = setups[name].trials if name in setups else ()
        trials = list(dict.fromkeys([*earlier, *request.trials]))
        setups[name], inputs[name] = replace(request, trials=trials), entry
    with ExitStack() as stack:
        journals = {
            name: stack.enter_context(Journal(workspace.cache / "trials" / f"{name}.jsonl", entry))
            for name, entry in inputs.items()
        }
        # 2. Read which trials are done, and fly the others in pieces of work.
        missing = [
            replace(setup, trials=journals[name].missing(setup.trials))
            for name, setup in setups.items()
        ]
        remaining = sum(len(request.trials) for request in missing)
        total = sum(len(setup.trials) for setup in setups.values())
        if remaining < total:
            console.note(f"{title}: {total - remaining} of {total} trials were flown before")
        if remaining:
            workers = workers_for(remaining, workspace.workers, "mujoco")
            cost = sum(relative_cost(one.simulator) * len(one.trials) for one in missing)
            announce(
                console, f"{title}: {counted(remaining, 'trial')}", flying_estimate(cost, workers)
            )
            trial_numbers, all_journals = count(total - remaining + 1), list(journals.values())
            with console.progress(title, total, begun=total - remaining) as update:

                def keep(piece: int, answer: tuple[int, TrialResult]) -> None:
                    """Store the result of a trial in the journal of its setup."""
                    journal_number, result = answer
                    all_journals[journal_number].append(result)
                    # A sweep has more journals than a process may have open files.
                    all_journals[journal_number].close()
                    update(next(trial_numbers))

                pieces = _pieces(missing, worker_count(workers))
                run_pieces(partial(_fly_piece, policies), pieces, workers, keep)
    # 3. Collect the results of each request.
    return {
        key: [journals[names[key]].done[trial] for trial in request.trials]
        for key, request in requests.items()
    }


def policy_name(policy: str) -> str:
    """Return the name of a policy.

    Raises:
        PolicyError: if the policy cannot be loaded, or if loading it can run code from its file,
            because a page never flies such a policy.
    """
    try:
        return load_policy(policy).name
    except NeedsTrust:
        raise PolicyError(
            f"{policy}: loading it can run its maker's code, which suite reproduce never does; "
            "give a checkpoint's folder or an .onnx file, or fly it with suite eval"
        ) from None


def named_policies(sources: Sequence[str]) -> dict[str, str]:
    """Return label -> source (name or path) of the policies.

    Without any source it is the default policy that the suite ships.
    """
    sources = sources or (default_policy(),)
    labels = policy_labels(sources, [policy_name(source) for source in sources])
    return dict(zip(labels, sources, strict=True))


def policy_facts(policies: Mapping[str, str]) -> dict[str, str]:
    """Return the source and the digest of each policy as text, for the facts of a page."""
    return {name: f"{path}, SHA-256 {policy_digest(path)[:16]}" for name, path in policies.items()}


def judged_trials(config: Any, levels: Sequence[int] | None = None) -> list[TrialSpec]:
    """Return the judged trials of an experiment, at `levels` or else those of its --difficulty."""
    levels = parse_levels(config.difficulty) if levels is None else levels
    return trial_list(JUDGED, levels, config.trials, config.seed)


Share = tuple[int, TrialRequest]
"""Number of a setup in the order of all setups, and trials of it in a piece of work."""


def _pieces(requests: Sequence[TrialRequest], processes: int) -> list[list[Share]]:
    """Cut the trials of all setups into pieces of about equal size for `processes`.

    A piece may have trials of several setups, and a setup with many trials is in several pieces.
    """
    total = sum(len(request.trials) for request in requests)
    piece_limit = total if processes == 1 else min(MOST_A_PIECE, math.ceil(total / processes))
    pieces: list[list[Share]] = [[]]
    size = 0
    for number, request in enumerate(requests):
        share_count = math.ceil(len(request.trials) / piece_limit)
        for share in (request.trials[k::share_count] for k in range(share_count)):
            if size and size + len(share) > piece_limit:
                pieces.append([])
                size = 0
            pieces[-1].append((number, replace(request, trials=share)))
            size += len(share)
    return pieces


def _fly_piece(
    loaders: Mapping[str, PolicyContent], piece: Sequence[Share]
) -> Iterator[tuple[int, TrialResult]]:
    """Fly a piece and yield (number of the setup, result) of each trial; load each policy once."""
    loaded: dict[str, Policy] = {}
    for number, request in piece:
        if request.policy not in loaded:
            loaded[request.policy] = loaders[request.policy]()
        options = JudgeOptions(workers=1, sensors=request.sensors)
        task = Task(loaded[request.policy], request.vehicle, request.simulator, options)
        for _, result, *_ in fly_share(task, list(enumerate(request.trials))):
            yield number, result
