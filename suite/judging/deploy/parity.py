"""How far an export in C is from the policy that it came from, step after step with memory.

What a policy is given on flights of the judge scales its 8-bit export, and is what both are given.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies.formats.c.c_file import load_c
from policies.formats.c.compiler import find_compiler
from policies.formats.c.forward import Observed
from policies.formats.c.project import answers_of, drawn, native_answers
from policies.formats.policy_file import PolicyCheckpoint
from policies.policy import Hidden, Policy
from policies.spec import PolicyError, PolicySpec
from suite.judging.deploy.latency import Timing, c_step, time_in_turn

STEPS = 1000


class Parity(NamedTuple):
    """An export and its policy, both given the same and each with a memory of its own."""

    steps: int
    """Steps in turn; 0 where no compiler is here and nothing was measured."""
    given: str
    """What observations."""
    worst: float
    """Largest difference of an action's number [m/s^2]."""
    median: float
    """The middle one [m/s^2]."""
    timing: Timing | None
    """Of a step on this machine."""

    @property
    def sentence(self) -> str:
        """For people."""
        if not self.steps or self.timing is None:
            return "not compiled and not compared here: no C compiler (cc, or what CC names)"
        return (
            f"compared with the JAX policy over {self.steps} steps with memory ({self.given}): "
            f"largest difference {self.worst:.2g} m/s^2, median {self.median:.2g}; a step takes "
            f"{1e6 * self.timing.median_s:.0f} us on this machine"
        )


def parity(folder: Path, checkpoint: PolicyCheckpoint, observed: Observed | None) -> Parity:
    """Compile the export in `folder` and compare it with its checkpoint.

    Args:
        folder: with policy.c and policy.h.
        checkpoint: where it came from.
        observed: what both are given; drawn at random where there is nothing.

    Raises:
        PolicyError: where it does not compile.
    """
    given = "on flights" if observed else "inputs drawn at random"
    if find_compiler() is None:
        return Parity(0, given, np.nan, np.nan, None)
    part = Observed(*(x[:STEPS] for x in observed or drawn(checkpoint.spec, STEPS, seed=1)))
    policy = load_c(folder, trust=True)
    apart = np.abs(
        answers_of(policy, part) - native_answers(checkpoint.params, checkpoint.spec, part)
    )
    if not np.isfinite(apart).all():
        raise PolicyError(f"{folder}: the compiled policy gives numbers that are not finite")
    timing = time_in_turn({"c": c_step(policy)}, rounds=5)["c"]
    return Parity(len(apart), given, float(apart.max()), float(np.median(apart)), timing)


TRACK = "random"
"""The training distribution: an export is not scaled by the tracks that it is judged on."""
LEVELS = tuple(range(10))
SEED = 900_000
"""Of the first flight; no table is flown from it."""


class Listener:
    """A policy that keeps what it was given, row by row of the judge's slots."""

    def __init__(self, policy: Policy) -> None:
        """Listen to what `policy` is given."""
        self._policy = policy
        self._given: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    @property
    def name(self) -> str:
        """What tables call it."""
        return self._policy.name

    @property
    def spec(self) -> PolicySpec:
        """The policy's own."""
        return self._policy.spec

    def start(self, n: int) -> Hidden:
        """Return the policy's memory of n trials."""
        return self._policy.start(n)

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return what the policy answers."""
        self._given.append((state.copy(), image.copy(), fresh.copy()))
        return self._policy.act(hidden, state, image, fresh)

    def heard(self) -> Observed:
        """Return all of it, flight after flight; rows in which nothing flew are left out."""
        state, image, fresh = (np.stack(each, 1) for each in zip(*self._given, strict=True))
        flew = np.abs(state).max(-1) > 0
        parts: list[Any] = [x[flew] for x in (state, image, fresh)]
        return Observed(*parts)


def observed_flights(
    policy: Policy, vehicle: str = "reference", levels: tuple[int, ...] = LEVELS
) -> Observed:
    """Return what `policy` is given on one flight of a random track at each level."""
    listener = Listener(policy)
    trials = [TrialSpec(TRACK, level, SEED + k) for k, level in enumerate(levels)]
    options = JudgeOptions(slots=len(trials), workers=1)
    fly(listener, trials, load_vehicle(vehicle), options=options)
    return listener.heard()
