"""Judged trials that are kept for good: whoever asks for the same flights again gets them at once.

What sets a trial's outcome (policy, vehicle, the judge's code, the engines) names a journal in the
cache, and each trial goes there as it ends; documents that share flights share the journal.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from eval.judging.judge import JudgeOptions, Task, fly_share
from eval.judging.results import Journal
from eval.judging.sensors import SensorNoise
from eval.judging.tables import Tally, summarise
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import Policy, load_policy
from suite.common.choices import parse_levels
from suite.common.console import Console
from suite.common.estimate import announce
from suite.experiments.study.cache import code_digest, digest, engines
from suite.judging.flying import (
    TRIALS_A_PROCESS,
    cost_of,
    flying_needs,
    policy_digest,
    trial_list,
)
from tracks.common.work import usable_cores, work_off
from tracks.families import JUDGED

Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Flier:
    """Who flies on what: with a trial it sets the outcome."""

    policy: str
    """A shipped policy's name, a checkpoint's folder, or a policy file."""
    vehicle: Vehicle
    """On what."""
    noise: SensorNoise = field(default_factory=SensorNoise)
    """What is wrong with what it sees."""
    world: str = "mujoco"
    """In which world."""


@dataclass(frozen=True)
class Order:
    """Trials wanted of one flier."""

    flier: Flier
    trials: Sequence[TrialSpec]


def flown(
    orders: Mapping[Key, Order], cache: Path, console: Console, what: str
) -> dict[Key, list[TrialResult]]:
    """Return the results of every order; those not in `cache` are flown first.

    An interrupt keeps what was flown.

    Args:
        orders: what is wanted; the same flier may be in several.
        cache: folder of the journals.
        console: where progress goes.
        what: a few words on what is flown.

    Raises:
        ValueError: for a policy that cannot be loaded, before the first flight.
    """
    about = {key: _about(order.flier) for key, order in orders.items()}
    names = {key: digest(entry) for key, entry in about.items()}
    fliers = {names[key]: order.flier for key, order in orders.items()}
    wanted: dict[str, dict[TrialSpec, None]] = {name: {} for name in fliers}
    for key, order in orders.items():
        wanted[names[key]].update(dict.fromkeys(order.trials))
    with ExitStack() as stack:
        journals = {
            name: stack.enter_context(Journal(cache / "trials" / f"{name}.jsonl", entry))
            for name, entry in {names[key]: entry for key, entry in about.items()}.items()
        }
        missing = [journals[name].missing(list(trials)) for name, trials in wanted.items()]
        left, total = sum(map(len, missing)), sum(map(len, wanted.values()))
        if left < total:
            console.note(f"{what}: {total - left} of {total} trials were flown before")
        if left:
            processes = min(usable_cores(), max(1, left // TRIALS_A_PROCESS))
            costs = [cost_of(flier.world) for flier in fliers.values()]
            cost = sum(c * len(trials) for c, trials in zip(costs, missing, strict=True))
            announce(console, f"{what}: {left} trials", flying_needs(cost, processes))
            numbers, open_journals = count(total - left + 1), list(journals.values())
            with console.progress(what, total) as update:

                def keep(piece: int, ended: tuple[int, TrialResult]) -> None:
                    number, result = ended
                    open_journals[number].append(result)
                    update(next(numbers))

                shares = _shares(missing, processes)
                pieces = [shares[k::processes] for k in range(processes)]
                work = partial(_fly_shares, list(fliers.values()))
                work_off(work, pieces, processes, keep)
    return {
        key: [journals[names[key]].done[trial] for trial in order.trials]
        for key, order in orders.items()
    }


def judged_cells(
    orders: Mapping[str, Order], cache: Path, console: Console, what: str
) -> tuple[dict[str, list[TrialResult]], dict[str, list[Tally]]]:
    """Return results and their cells, as `flown` does, by what tables call the policies."""
    results = flown(orders, cache, console, what)
    return results, {
        name: summarise([row._replace(policy=name) for row in rows])["cells"]
        for name, rows in results.items()
    }


def trials_of(config: Any, levels: Sequence[int] | None = None) -> list[TrialSpec]:
    """Return an experiment's judged trials, at `levels` or those of its --difficulty."""
    levels = parse_levels(config.difficulty) if levels is None else levels
    return trial_list(JUDGED, levels, config.trials, config.seed)


def _about(flier: Flier) -> dict[str, Any]:
    """Return all that sets the outcome of a trial besides the trial."""
    return {
        "policy_sha256": policy_digest(flier.policy),
        "vehicle": flier.vehicle,
        "noise": flier.noise,
        "world": flier.world,
        "code": code_digest("tracks", "policies", "eval"),
        "engines": engines(),
    }


Share = tuple[int, list[TrialSpec]]
"""Trials of one flier, by its number."""


def _shares(missing: Sequence[list[TrialSpec]], processes: int) -> list[Share]:
    """Cut each flier's trials into pieces that are worth a process of their own."""
    shares = []
    for number, trials in enumerate(missing):
        pieces = max(1, min(processes, len(trials) // TRIALS_A_PROCESS))
        shares += [(number, trials[k::pieces]) for k in range(pieces) if trials]
    return shares


def _fly_shares(
    fliers: Sequence[Flier], shares: Sequence[Share]
) -> Iterator[tuple[int, TrialResult]]:
    """Yield (number of the flier, result) of trials flown here; each policy is loaded once."""
    loaded: dict[str, Policy] = {}
    for number, trials in shares:
        flier = fliers[number]
        if flier.policy not in loaded:
            loaded[flier.policy] = load_policy(flier.policy)
        options = JudgeOptions(processes=1, noise=flier.noise)
        task = Task(loaded[flier.policy], flier.vehicle, flier.world, options)
        for _, result, _ in fly_share(task, list(enumerate(trials))):
            yield number, result
