"""How far an export in C is from the policy that it came from, step after step with memory."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from policies.errors import PolicyError
from policies.formats.c.c_file import load_c
from policies.formats.c.compiler import find_compiler
from policies.formats.c.forward import Observed
from policies.formats.c.project import answers_of, drawn, native_answers
from policies.formats.policy_file import PolicyCheckpoint
from suite.judging.deploy.latency import Timing, c_step, time_in_turn

STEPS = 1000


class Parity(NamedTuple):
    """An export beside its policy, both given the same and each with a memory of its own."""

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
            f"beside the JAX policy over {self.steps} steps with memory ({self.given}): "
            f"{self.worst:.2g} m/s^2 off at most, {self.median:.2g} in the middle; a step takes "
            f"{1e6 * self.timing.median_s:.0f} us here"
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
