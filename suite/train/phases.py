"""The phases of a run: what changes on the way from random weights to the finished policy.

A phase's settings are those of the phase before with its own changes made, so that a schedule reads
as a list of differences. A user's change by --set holds in every phase; `phases.2.loss.progress=2`
changes one phase alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from suite.train.config import Phase, TrainConfig, check
from suite.train.overrides import override
from tracks.input.ranges import shown

PREFIX = "phases."


def phase_ends(config: TrainConfig) -> tuple[int, ...]:
    """Return how many gradient steps of the run are done at the end of each phase."""
    total, done = config.optimizer.iterations, 0.0
    ends = []
    for phase in config.phases or (Phase(),):
        done += phase.share
        ends.append(min(total, round(done * total)))
    return tuple(ends)


def phase_configs(config: TrainConfig) -> tuple[TrainConfig, ...]:
    """Return the settings of each phase, as runs of one phase with as many gradient steps.

    Raises:
        ValueError: for a change that cannot be made, naming the phase.
    """
    now, configs, begun = replace(config, phases=()), [], 0
    phases = config.phases or (Phase(),)
    for number, (phase, end) in enumerate(zip(phases, phase_ends(config), strict=True), 1):
        try:
            now = override(now, phase.set)
        except ValueError as error:
            raise ValueError(f"phase {number}: {error}") from error
        optimizer = replace(now.optimizer, iterations=max(1, end - begun))
        configs.append(replace(now, optimizer=optimizer))
        begun = end
    return tuple(configs)


def last_phase(config: TrainConfig) -> TrainConfig:
    """Return the settings with which a run ends, for as many gradient steps as the whole run."""
    last = phase_configs(config)[-1]
    return replace(last, optimizer=replace(last.optimizer, iterations=config.optimizer.iterations))


def check_phases(config: TrainConfig) -> None:
    """Refuse a run with a phase that cannot be trained, before anything is compiled or written.

    Raises:
        ValueError: naming the setting, its value and what is allowed.
    """
    check(config)
    total = math.fsum(phase.share for phase in config.phases)
    if config.phases and not math.isclose(total, 1.0, abs_tol=1e-6):
        raise ValueError(f"the shares of phases add up to {total:g}, allowed is 1")
    configs = phase_configs(config)
    for number, one in enumerate(configs, 1):
        check(one)
        fixed = {
            "spec": replace(one.spec, rate_hz=config.spec.rate_hz, speed=config.spec.speed),
            "episode.batch": one.episode.batch,
            "episode.shards": one.episode.shards,
            "seed": one.seed,
        }
        before = {
            "spec": config.spec,
            "episode.batch": config.episode.batch,
            "episode.shards": config.episode.shards,
            "seed": config.seed,
        }
        for key, value in fixed.items():
            if value != before[key]:
                raise ValueError(
                    f"phase {number} changes {key}, which a whole run has in common (of spec, "
                    "rate_hz and speed may change); set it without a phase"
                )


def changed(config: TrainConfig, changes: Iterable[str]) -> TrainConfig:
    """Return a run with a user's changes made: SETTING=VALUE in every phase, or in one alone.

    Args:
        config: the run.
        changes: such as "loss.progress=0.4", or "phases.2.loss.progress=0.4" for its second phase.

    Raises:
        ValueError: naming the setting, what is wrong with it and what is allowed.
    """
    everywhere, phases = [], list(config.phases)
    for change in changes:
        if not change.startswith(PREFIX):
            everywhere.append(change)
            continue
        number, _, rest = change.removeprefix(PREFIX).partition(".")
        if not (number.isdecimal() and 1 <= int(number) <= len(phases)):
            raise ValueError(
                f"--set {shown(change)}: this run has {len(phases)} phases; write phases.N.SETTING="
                "VALUE with N from 1"
            )
        phase = phases[int(number) - 1]
        phases[int(number) - 1] = replace(phase, set=(*phase.set, rest))
    paths = {change.partition("=")[0].strip() for change in everywhere}
    kept = (
        replace(phase, set=tuple(c for c in phase.set if c.partition("=")[0] not in paths))
        for phase in phases
    )
    return override(replace(config, phases=tuple(kept)), everywhere)
