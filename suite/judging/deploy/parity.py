"""Measure the parity of an export in C: how much its actions differ from those of the policy.

Both get the same observations, and keep their recurrent memory over many steps. An export with
weights of 8 bits (int8) needs observations from simulated flights, which also set the scales of its
activations.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies.contract import contract_of
from policies.formats.c.c_file import load_c
from policies.formats.c.compiler import find_compiler
from policies.formats.c.forward import Observed
from policies.formats.c.project import actions_of, native_actions, random_observations
from policies.formats.policy_file import PolicyCheckpoint
from policies.policy import Hidden, Policy, Wrapper
from policies.spec import PolicyError
from suite.judging.deploy.latency import Timing, c_step, time_in_turn
from suite.judging.trials import LEVELS

STEPS = 1000
"""Number of compared steps."""


class Parity(NamedTuple):
    """Differences between the actions of an export and of its policy, on the same inputs."""

    steps: int
    """Number of compared steps; 0 if there is no compiler and nothing was measured."""
    given: str
    """Description of the inputs, the observations."""
    worst: float
    """Largest difference of a component of an action, in `unit`."""
    median: float
    """Median of these differences."""
    timing: Timing | None
    """Times of a step of the export on this machine; None if nothing was measured."""
    unit: str
    """Units of an action's components."""

    @property
    def sentence(self) -> str:
        """The result as a sentence."""
        if self.timing is None:
            return "not compiled and not compared here: no C compiler (cc, or what CC names)"
        return (
            f"compared with the JAX policy over {self.steps} steps with memory ({self.given}): "
            f"largest difference {self.worst:.2g} {self.unit}, median {self.median:.2g}; a step "
            f"takes {1e6 * self.timing.median_s:.0f} us on this machine"
        )


def parity(folder: Path, checkpoint: PolicyCheckpoint, observed: Observed | None) -> Parity:
    """Compile the export in `folder` (policy.c, policy.h) and compare it with its checkpoint.

    Without `observed`, the inputs of both are drawn at random.

    Raises:
        PolicyError: if the export does not compile, or computes numbers that are not finite.
    """
    given = "on flights" if observed else "inputs drawn at random"
    unit = " or ".join(dict.fromkeys(contract_of(checkpoint.spec).action.unit))
    if find_compiler() is None:
        return Parity(0, given, np.nan, np.nan, None, unit)
    inputs = Observed(
        *(x[:STEPS] for x in observed or random_observations(checkpoint.spec, STEPS, seed=1))
    )
    policy = load_c(folder, trust=True)
    expected = native_actions(checkpoint.params, checkpoint.spec, inputs)
    errors = np.abs(actions_of(policy, inputs) - expected)
    if not np.isfinite(errors).all():
        raise PolicyError(f"{folder}: the compiled policy gives numbers that are not finite")
    timing = time_in_turn({"c": c_step(policy)}, rounds=5)["c"]
    return Parity(len(errors), given, float(errors.max()), float(np.median(errors)), timing, unit)


TRACK = "random"
"""Family of the flights whose inputs are recorded. It is that of the training, so that the tracks
of the results tables do not affect an export."""
SEED = 900_000
"""Seed of the first of these flights; no results table uses it."""


class Recorder(Wrapper):
    """A policy that records its inputs in all flights, which the judge flies at once as a batch."""

    def __init__(self, policy: Policy) -> None:
        """Record the inputs of `policy`."""
        super().__init__(policy)
        self._inputs: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return the policy's actions and memory."""
        self._inputs.append((state.copy(), image.copy(), fresh.copy()))
        return super().act(hidden, state, image, fresh)

    def observed(self) -> Observed:
        """Return the recorded inputs, one flight after the other.

        Inputs after the end of a flight are left out; the state vector is then zero.
        """
        # (flights, steps, ...)
        state, image, fresh = (np.stack(each, 1) for each in zip(*self._inputs, strict=True))
        is_flying = np.abs(state).max(-1) > 0
        arrays: list[Any] = [x[is_flying] for x in (state, image, fresh)]
        return Observed(*arrays)


def observed_flights(policy: Policy, levels: tuple[int, ...] = LEVELS) -> Observed:
    """Return the inputs of `policy` on one flight of a random track at each level."""
    recorder = Recorder(policy)
    trials = [TrialSpec(TRACK, level, SEED + k) for k, level in enumerate(levels)]
    options = JudgeOptions(slots=len(trials), workers=1)
    fly(recorder, trials, load_vehicle("reference"), options=options)
    return recorder.observed()
