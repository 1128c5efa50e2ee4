"""Check that the rows of a policy object are separate trials, and that a new trial starts anew."""

from __future__ import annotations

import contextlib
import copy

import numpy as np

from eval.judging.policy_checks.responses import ASIDE_M, VEL_B, level_states
from policies.block_policy import ROUNDING
from policies.policy import Hidden, Policy, checked_act
from policies.spec import Note

ROWS = 3
"""Number of rows with which policy objects are tested."""
DECISIONS = 2
"""Number of decisions of a test; each has another observation."""


def check_rows(policy: Policy) -> tuple[Note, ...]:
    """Refuse a policy object whose answer for a row depends on the other rows.

    A row is the observation of one trial. If possible a copy is tested, so that the object itself
    stays as it is. An object that fails here, as it takes another number of rows, is not tested;
    one that fails only for a single row, as a batch normalisation in training does, is.

    Returns:
        A note if the same inputs give two answers, so that the policy is random or keeps memory in
        itself, or if a new trial in a row depends on the trial before.

    Raises:
        ValueError: naming the largest change of an answer.
    """
    tested = policy
    with contextlib.suppress(Exception):  # an object that cannot be copied is tested itself
        tested = copy.deepcopy(policy)
    try:
        first, hidden = _answers(tested, ROWS, 0)
        refilled = _answers(tested, ROWS, 0, hidden)[0]
        again, other = (_answers(tested, ROWS, seed)[0] for seed in (0, 1))
    except Exception:  # any error of an object's own code; the judge reports it
        return ()
    alone = first
    with contextlib.suppress(Exception):
        alone = _answers(tested, 1, 0)[0]
    if first.shape[1:] != (ROWS, policy.spec.action.size) or first.dtype.kind not in "fiu":
        return ()  # the judge refuses these actions
    if first.tobytes() != again.tobytes():
        text = (
            f"policy {policy.name!r}: the same inputs gave two answers. It is random, or its "
            "memory is in the object, so that results depend on earlier trials"
        )
        return (Note("memory_outside", text, "keep it in hidden"),)
    compared = [answers[:, 0] for answers in (other, alone) if answers.shape[1]]
    change = max(np.abs(answers - first[:, 0]).max() for answers in compared)
    if change > ROUNDING * max(1.0, np.abs(first).max()):
        raise ValueError(
            f"policy {policy.name!r}: a row's action changes by {change:.2g} with the other rows "
            "of its batch; rows are separate trials (docs/policies.md); torch networks need eval()"
        )
    if first.tobytes() != refilled.tobytes():
        text = f"policy {policy.name!r}: the memory of a trial goes on into the next one of its row"
        return (Note("memory_not_reset", text, "where fresh is True, start from start(n)"),)
    return ()


def _answers(
    policy: Policy, count: int, seed: int, hidden: Hidden = None
) -> tuple[np.ndarray, Hidden]:
    """Return the actions (DECISIONS, count, size) of a policy in new trials, and its memory.

    The seed changes all rows but the first. `hidden` is the memory of the trials before; without
    it the policy starts.
    """
    spec = policy.spec
    rows = [np.random.default_rng([row, seed if row else 0]) for row in range(count)]
    hidden = policy.start(count) if hidden is None else hidden
    most, actions = 255.0 if spec.depth.uint8 else 2.0, []
    for decision in range(DECISIONS):
        state = level_states(spec, ASIDE_M * np.stack([rng.normal(size=2) for rng in rows]))
        state[:, VEL_B] += np.stack([rng.normal(size=3) for rng in rows])
        image = np.stack([rng.uniform(0.0, most, spec.image_shape) for rng in rows])
        fresh = np.full(count, decision == 0)
        action, hidden = checked_act(policy, hidden, state, image.astype(np.float32), fresh)
        actions.append(np.asarray(action).copy())  # a tensor too
    return np.stack(actions), hidden
