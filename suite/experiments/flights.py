"""Judged trials that are kept for good: whoever asks for the same flights again gets them at once.

What sets a trial's outcome (policy, vehicle, the judge's code, the engines) names a journal in the
cache, and each trial goes there as it ends; documents that share flights share the journal.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

from eval.judging.judge import JudgeOptions, Task, fly_share
from eval.judging.results import Journal
from eval.judging.sensors import SensorNoise
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import TrialResult, TrialSpec
from policies.policy import Policy, load_policy
from suite.common.console import Console
from suite.common.estimate import Estimate, announce
from suite.experiments.cache import code_digest, digest, engines
from suite.judging.flying import (
    PROCESS_BYTES,
    SECONDS_A_TRIAL,
    START_SECONDS,
    TRIALS_A_PROCESS,
    policy_digest,
)
from tracks.common.work import usable_cores, work_off


@dataclass(frozen=True)
class Flier:
    """Who flies on what: with a trial it sets the outcome."""

    policy: str
    """A shipped policy's name, a checkpoint's folder, or a policy file."""
    vehicle: Vehicle
    """On what."""
    noise: SensorNoise = field(default_factory=SensorNoise)
    """What is wrong with what it sees."""


@dataclass(frozen=True)
class Order:
    """Trials wanted of one flier."""

    flier: Flier
    trials: Sequence[TrialSpec]


def flown(
    orders: Sequence[Order],
    cache: Path,
    console: Console,
    what: str,
    processes: int | None = None,
) -> list[list[TrialResult]]:
    """Return the results of every order, in its order; those not in `cache` are flown first.

    An interrupt keeps what was flown.

    Args:
        orders: what is wanted; the same flier may be in several.
        cache: folder of the journals.
        console: where progress goes.
        what: a few words on what is flown.
        processes: that share the flights; None takes what is worth it.

    Raises:
        ValueError: for a policy that cannot be loaded, before the first flight.
    """
    about = [_about(order.flier) for order in orders]
    keys = [digest(entry) for entry in about]
    by_key: dict[str, list[Order]] = {}
    for key, order in zip(keys, orders, strict=True):
        by_key.setdefault(key, []).append(order)
    fliers = [same[0].flier for same in by_key.values()]
    with ExitStack() as stack:
        journals = {
            key: stack.enter_context(Journal(cache / "trials" / f"{key}.jsonl", entry))
            for key, entry in dict(zip(keys, about, strict=True)).items()
        }
        wanted = [
            list(dict.fromkeys(chain(*(order.trials for order in same))))
            for same in by_key.values()
        ]
        open_journals = list(journals.values())
        missing = [j.missing(trials) for j, trials in zip(open_journals, wanted, strict=True)]
        left, total = sum(map(len, missing)), sum(map(len, wanted))
        if left < total:
            console.note(f"{what}: {total - left} of {total} trials were flown before")
        if left:
            processes = processes or min(usable_cores(), max(1, left // TRIALS_A_PROCESS))
            seconds = START_SECONDS + left * SECONDS_A_TRIAL / processes
            announce(
                console, f"{what}: {left} trials", Estimate(seconds, processes * PROCESS_BYTES)
            )
            numbers = count(total - left + 1)
            with console.progress(what, total) as update:

                def keep(piece: int, ended: tuple[int, TrialResult]) -> None:
                    number, result = ended
                    open_journals[number].append(result)
                    update(next(numbers))

                shares = _shares(missing, processes)
                pieces = [shares[k::processes] for k in range(processes)]
                work_off(partial(_fly_shares, fliers), pieces, processes, keep)
    return [
        [journals[key].done[trial] for trial in order.trials]
        for key, order in zip(keys, orders, strict=True)
    ]


def _about(flier: Flier) -> dict[str, Any]:
    """Return all that sets the outcome of a trial besides the trial."""
    return {
        "policy_sha256": policy_digest(flier.policy),
        "vehicle": flier.vehicle,
        "noise": flier.noise,
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
        task = Task(loaded[flier.policy], flier.vehicle, options=options)
        for _, result, _ in fly_share(task, list(enumerate(trials))):
            yield number, result
