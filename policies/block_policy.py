"""Wrap a model of any kind as a `Policy` that always runs on blocks of the same number of rows.

A row is the observation of one trial (one judged flight), and its output must not depend on other
rows. Matrix products of different sizes sum in different orders, so the model always gets full
blocks, padded with zeros. If a row still depends on others (some kernels treat the last rows of a
block differently), only one row of each block is used.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from policies.spec import ACTIONS, NoAnswer, Note, PolicyError, PolicySpec, check_spec
from tracks.input.ranges import Range, check_number, check_type, shown

Model = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""Maps (state, image, hidden) to (action, hidden) for exactly one block of rows, all float32."""

BLOCK = 64
"""Number of rows of a block, unless the model has a fixed batch size."""
ROUNDING = 1e-4
"""Largest relative change of a row's output by other rows that counts as rounding."""


@final
@dataclass(frozen=True)
class BlockPolicy:
    """A `Policy` around a model that takes a fixed number of rows."""

    name: str
    """Name of the policy in tables."""
    spec: PolicySpec
    """The rate, camera and scaling that the policy expects."""
    model: Model
    """The network."""
    hidden_shape: tuple[int, ...]
    """Shape of one row's recurrent state; (0,) for a policy without memory."""
    block: int = BLOCK
    """Number of rows in each call of the model."""
    rows: int = BLOCK
    """Number of rows of a block that are used, from the first row on: `block`, or 1."""
    notes: tuple[Note, ...] = ()
    """Assumptions about the policy that its file does not state."""

    def __post_init__(self) -> None:
        """Refuse arguments of other types, and other numbers of rows, with a ValueError."""
        check_type("BlockPolicy: name", self.name, (str,), "a text")
        check_type("BlockPolicy: spec", self.spec, (PolicySpec,), "a policies.spec.PolicySpec")
        check_spec(self.spec, "BlockPolicy: spec.")
        allowed = "a function (state, image, hidden) -> (action, hidden)"
        check_type("BlockPolicy: model", self.model, (Callable,), allowed)
        allowed = "a tuple of whole numbers, such as (64,); (0,) without memory"
        check_type("BlockPolicy: hidden_shape", self.hidden_shape, (tuple, list), allowed)
        check_type("BlockPolicy: notes", self.notes, (tuple, list), "a tuple of Note")
        for size in self.hidden_shape:
            allowed = Range(0, 2**31, whole=True)
            check_number("BlockPolicy: hidden_shape", size, allowed, shown(self.hidden_shape))
        check_number("BlockPolicy: block", self.block, Range(1, 2**31, whole=True))
        if self.rows not in (1, self.block):
            raise ValueError(
                f"BlockPolicy: rows is {shown(self.rows)}, allowed is the block, {self.block}, or 1"
            )

    def start(self, n: int) -> np.ndarray:
        """Return the recurrent state at the start of n trials, (n, *hidden_shape) zeros."""
        return np.zeros((n, *self.hidden_shape), np.float32)

    def act(
        self, hidden: np.ndarray, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the actions (n, spec.action.size) and the new state; see `Policy.act`.

        Where the recurrent state overflows, the action is NaN; the judge (the part of the suite
        that flies and scores policies) counts it as a bad action.
        """
        hidden = np.where(np.reshape(fresh, (-1, *[1] * len(self.hidden_shape))), 0, hidden)
        inputs = [np.asarray(x, np.float32) for x in (state, image, hidden)]
        if len(state) == self.rows == self.block:
            return _nan_if_overflowed(*self.model(*inputs))
        actions = np.empty((len(state), self.spec.action.size), np.float32)
        next_hidden = np.empty_like(inputs[2])
        for low in range(0, len(state), self.rows):
            used = slice(low, min(low + self.rows, len(state)))
            action, block_hidden = self.model(*(self._padded(x[used]) for x in inputs))
            actions[used] = action[: used.stop - low]
            next_hidden[used] = block_hidden[: used.stop - low]
        return _nan_if_overflowed(actions, next_hidden)

    def _padded(self, rows: np.ndarray) -> np.ndarray:
        """Return `rows` padded with zeros to a full block."""
        if len(rows) == self.block:
            return rows
        block = np.zeros((self.block, *rows.shape[1:]), np.float32)
        block[: len(rows)] = rows
        return block


def verify_rows(policy: BlockPolicy, where: str) -> BlockPolicy:
    """Test a loaded model, and return a policy whose rows do not influence each other.

    The test runs a block of random rows twice. Then it runs some of these rows again: each repeated
    to fill a block, and each among zeros. If a row's output changes by rounding, the returned
    policy runs one row at a time.

    Raises:
        PolicyError: where the outputs have wrong shapes, the same inputs give different outputs, or
            an output depends on the other rows by more than rounding.
    """
    rng = np.random.default_rng(0)
    n = policy.block
    state, image, hidden = random_block(policy, rng)
    first = policy.model(state, image, hidden)
    expected = ((n, policy.spec.action.size), (n, *policy.hidden_shape))
    for name, value, shape in zip(("action", "hidden"), first, expected, strict=True):
        if value.shape != shape or value.dtype != np.float32:
            sizes = ", ".join(f"{len(names)} with {kind}" for kind, names in ACTIONS.items())
            fix = f"the numbers of an action depend on action.kind: {sizes}; "
            raise PolicyError(
                f"{where}: output {name!r} is {value.dtype} {value.shape} for {n} rows, expected "
                f"float32 {shape}; {fix if name == 'action' else ''}see docs/policies.md"
            )
    if not _same(first, policy.model(state, image, hidden)):
        raise PolicyError(
            f"{where}: the same inputs gave two outputs; export the policy in evaluation mode, "
            "without dropout and sampling"
        )
    one_by_one = False
    for row in rng.choice(n, min(n, 8), replace=False):
        repeated = (np.repeat(x[row : row + 1], n, 0) for x in (state, image, hidden))
        reference = tuple(np.repeat(x[row : row + 1], n, 0) for x in first)
        among_zeros = (np.where(np.arange(n).reshape(-1, *[1] * (x.ndim - 1)) == row, x, 0)
                       for x in (state, image, hidden))  # fmt: skip
        single = tuple(x[row : row + 1] for x in policy.model(*among_zeros))
        for outputs in (policy.model(*repeated), single):
            expected = tuple(x[: len(outputs[0])] for x in reference)
            _refuse_batch_dependence(expected, outputs, where)
            one_by_one |= not _same(expected, outputs)
    return dataclasses.replace(policy, rows=1) if one_by_one else policy


def _refuse_batch_dependence(
    expected: tuple[np.ndarray, ...], outputs: tuple[np.ndarray, ...], where: str
) -> None:
    """Refuse outputs that depend on the other rows by more than rounding, as with BatchNorm."""
    for reference, value in zip(expected, outputs, strict=True):
        scale = max(1.0, float(np.abs(reference).max(initial=0.0)))
        difference = float(np.abs(value - reference).max(initial=0.0))
        if difference > ROUNDING * scale:
            raise PolicyError(
                f"{where}: a row's output changes by {difference:.2g} with its batch; "
                "a layer takes statistics over the batch (BatchNorm in training mode): call "
                "module.eval() before the export"
            )


def for_one_row(policy: BlockPolicy) -> BlockPolicy:
    """Return a faster policy for one vehicle, whose blocks have one row.

    The policy is returned unchanged if its model refuses one row or gives different outputs for it.
    Rounding differs from the rounding in a block, so the judge does not use this function.
    """
    inputs = random_block(policy, np.random.default_rng(0))
    in_block = policy.model(*inputs)
    try:
        single = policy.model(*(x[:1] for x in inputs))
    except NoAnswer:
        return policy
    equal = all(
        value.shape == block[:1].shape
        and np.allclose(value, block[:1], 0.0, ROUNDING * max(1.0, np.abs(block).max(initial=0.0)))
        for value, block in zip(single, in_block, strict=True)
    )
    return dataclasses.replace(policy, block=1, rows=1) if equal else policy


def random_block(
    policy: BlockPolicy, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a block of random (state, image, hidden)."""
    n = policy.block
    state = rng.normal(size=(n, policy.spec.state_size)).astype(np.float32)
    image = rng.normal(size=(n, *policy.spec.image_shape)).astype(np.float32)
    hidden = rng.uniform(-1, 1, (n, *policy.hidden_shape)).astype(np.float32)
    return state, image, hidden


def _nan_if_overflowed(action: np.ndarray, hidden: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the outputs, with NaN actions in rows whose recurrent state is not finite."""
    overflowed = ~np.asarray(np.isfinite(hidden).all(axis=tuple(range(1, hidden.ndim))))
    if overflowed.any():
        action = np.where(overflowed[:, None], np.float32(np.nan), action)
    return action, hidden


def _same(outputs: tuple[np.ndarray, ...], other_outputs: tuple[np.ndarray, ...]) -> bool:
    """Return whether two outputs are equal to the bit."""
    return all(a.tobytes() == b.tobytes() for a, b in zip(outputs, other_outputs, strict=True))
