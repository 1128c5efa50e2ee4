"""Judged trials in a permanent cache: the same flight is flown only once.

A journal in the cache is named by the digest of all that determines an outcome: policy, vehicle,
the judge's code, the engines. Each trial is written there as it ends. All pages share the journals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, NamedTuple, TypeVar

from eval.judging.judge import MOST_A_PIECE, JudgeOptions, Task, fly_share
from eval.judging.results import Journal
from eval.sensors.sensors_file import PERFECT, SensorSet
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import Policy, load_policy
from policies.spec import NeedsTrust, PolicyError
from suite.common.console import Console
from suite.common.stages import announce
from suite.experiments.study.cache import FLIES, Place, code_digest, digest, engines
from suite.judging.content import PolicyContent, policy_digest
from suite.judging.flying import (
    TRIALS_A_PROCESS,
    cost_of,
    default_policy,
    flying_needs,
    labels,
    trial_list,
)
from suite.judging.requests import parse_levels
from tracks.common.work import Workers, run_pieces, usable_cores, worker_count
from tracks.families import JUDGED

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Setup:
    """Policy, vehicle, sensors and simulator; together with a trial they determine its outcome."""

    policy: str
    """A shipped policy's name, a checkpoint's folder, or a policy file."""
    vehicle: Vehicle
    """The vehicle that it flies."""
    sensors: SensorSet = PERFECT
    """Errors in what the policy sees."""
    simulator: str = "mujoco"
    """A name of `suite list simulators`."""


@dataclass(frozen=True)
class Order:
    """Trials of one setup."""

    setup: Setup
    trials: Sequence[TrialSpec]


def flown(
    orders: Mapping[Key, Order], place: Place, console: Console, what: str
) -> dict[Key, list[TrialResult]]:
    """Return the results of every order; those not in the cache are flown first.

    After an interrupt, finished trials stay in the cache.

    Args:
        orders: several may have the same setup.
        place: folder of the journals, and the workers; without workers as many processes of this
            machine as shorten the work.
        console: shows progress.
        what: label of the progress.

    Raises:
        ValueError: for a policy that cannot be loaded, before the first flight.
    """
    policies = {order.setup.policy for order in orders.values()}
    digests = {policy: policy_digest(policy) for policy in policies}
    about = {key: _about(order.setup, digests) for key, order in orders.items()}
    names = {key: digest(entry) for key, entry in about.items()}
    setups = {names[key]: order.setup for key, order in orders.items()}
    wanted: dict[str, dict[TrialSpec, None]] = {name: {} for name in setups}
    for key, order in orders.items():
        wanted[names[key]].update(dict.fromkeys(order.trials))
    with ExitStack() as stack:
        journals = {
            name: stack.enter_context(Journal(place.cache / "trials" / f"{name}.jsonl", entry))
            for name, entry in {names[key]: entry for key, entry in about.items()}.items()
        }
        missing = [journals[name].missing(list(trials)) for name, trials in wanted.items()]
        left, total = sum(map(len, missing)), sum(map(len, wanted.values()))
        if left < total:
            console.note(f"{what}: {total - left} of {total} trials were flown before")
        if left:
            workers = place.workers or min(usable_cores(), max(1, left // TRIALS_A_PROCESS))
            costs = [cost_of(setup.simulator) for setup in setups.values()]
            cost = sum(c * len(trials) for c, trials in zip(costs, missing, strict=True))
            announce(console, f"{what}: {left} trials", flying_needs(cost, workers))
            numbers, all_journals = count(total - left + 1), list(journals.values())
            with console.progress(what, total) as update:

                def keep(piece: int, ended: tuple[int, TrialResult]) -> None:
                    number, result = ended
                    all_journals[number].append(result)
                    # A sweep has more journals than a process may have open files.
                    all_journals[number].close()
                    update(next(numbers))

                loaders = _loaders(policies, workers)
                pieces = _pieces(list(setups.values()), missing, worker_count(workers))
                run_pieces(partial(_fly_piece, loaders), pieces, workers, keep)
    return {
        key: [journals[names[key]].done[trial] for trial in order.trials]
        for key, order in orders.items()
    }


def name_of(policy: str) -> str:
    """Return the name of a policy that a page may fly.

    Raises:
        PolicyError: if it cannot be loaded, or loading it can run code from its file.
    """
    try:
        return load_policy(policy).name
    except NeedsTrust:
        raise PolicyError(
            f"{policy}: loading it can run its maker's code, which suite reproduce does of no "
            "policy; give a checkpoint's folder or an .onnx file, or fly it with suite eval"
        ) from None


def named_policies(given: Sequence[str]) -> dict[str, str]:
    """Return the given policies, or the shipped one, by label."""
    given = given or (default_policy(),)
    return dict(zip(labels(given, [name_of(path) for path in given]), given, strict=True))


def policy_facts(policies: Mapping[str, str]) -> dict[str, str]:
    """Return name and digest of each policy, for the facts of a page."""
    return {name: f"{path}, SHA-256 {policy_digest(path)[:16]}" for name, path in policies.items()}


def trials_of(config: Any, levels: Sequence[int] | None = None) -> list[TrialSpec]:
    """Return an experiment's judged trials, at `levels` or those of its --difficulty."""
    levels = parse_levels(config.difficulty) if levels is None else levels
    return trial_list(JUDGED, levels, config.trials, config.seed)


def _about(setup: Setup, digests: Mapping[str, str]) -> dict[str, Any]:
    """Return everything but the trial that determines an outcome."""
    return {
        "policy_sha256": digests[setup.policy],
        "vehicle": setup.vehicle,
        "sensors": setup.sensors,
        "world": setup.simulator,
        "code": code_digest(*FLIES),
        "engines": engines(),
    }


Loaders = dict[str, Callable[[], Policy]]
"""Function that loads each policy in the process that flies it."""


class Share(NamedTuple):
    """Trials of one setup."""

    number: int
    """Number of the setup."""
    setup: Setup
    trials: Sequence[TrialSpec]


def _loaders(policies: Iterable[str], workers: Workers) -> Loaders:
    """Return functions that load policies: by name on this machine, by content on others."""
    if isinstance(workers, int):
        return {name: partial(load_policy, name) for name in policies}
    return {name: PolicyContent.of(name) for name in policies}


def _pieces(
    setups: Sequence[Setup], missing: Sequence[Sequence[TrialSpec]], processes: int
) -> list[list[Share]]:
    """Cut the trials of all setups into pieces of about equal size for `processes`."""
    total = sum(map(len, missing))
    most = total if processes == 1 else min(MOST_A_PIECE, math.ceil(total / processes))
    pieces: list[list[Share]] = [[]]
    held = 0
    for number, (setup, trials) in enumerate(zip(setups, missing, strict=True)):
        cut = math.ceil(len(trials) / most) if trials else 0
        for part in (trials[k::cut] for k in range(cut)):
            if held and held + len(part) > most:
                pieces.append([])
                held = 0
            pieces[-1].append(Share(number, setup, part))
            held += len(part)
    return pieces


def _fly_piece(loaders: Loaders, piece: Sequence[Share]) -> Iterator[tuple[int, TrialResult]]:
    """Fly a piece and yield (number of the setup, result); each policy is loaded once."""
    loaded: dict[str, Policy] = {}
    for number, setup, trials in piece:
        if setup.policy not in loaded:
            loaded[setup.policy] = loaders[setup.policy]()
        options = JudgeOptions(workers=1, sensors=setup.sensors)
        task = Task(loaded[setup.policy], setup.vehicle, setup.simulator, options)
        for _, result, _ in fly_share(task, list(enumerate(trials))):
            yield number, result
