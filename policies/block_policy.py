"""A model of any kind as a `Policy`: it always runs on blocks of one size.

A trial's outcome must depend on its own row alone. Matrix products of different sizes sum in
different orders, so the model always gets full blocks, padded with zeros. If that is not enough
(some kernels treat the last rows of a block differently), each row runs in a block of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from policies.spec import NoAnswer, Note, PolicyError, PolicySpec

Model = Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]
"""(state, image, hidden) to (action, hidden) for exactly one block of rows, float32 arrays."""

BLOCK = 64
"""Rows of a block, unless the model has a fixed batch."""
ROUNDING = 1e-4
"""Largest relative difference of a row's outputs, alone and in a block."""


@final
@dataclass(frozen=True)
class BlockPolicy:
    """A `Policy` around a model that takes a fixed number of rows."""

    name: str
    """Name in tables."""
    spec: PolicySpec
    """The rate, camera and scaling that it expects."""
    model: Model
    """The network."""
    hidden_shape: tuple[int, ...]
    """Shape of one row's recurrent state; (0,) for a policy without memory."""
    block: int = BLOCK
    """Rows of each call of the model."""
    rows: int = BLOCK
    """Number of rows of a block that are used, from the first: `block`, or 1."""
    notes: tuple[Note, ...] = ()
    """Assumptions about its file."""

    def start(self, n: int) -> np.ndarray:
        """Return the recurrent state at the start of n trials, zeros."""
        return np.zeros((n, *self.hidden_shape), np.float32)

    def act(
        self, hidden: np.ndarray, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (action (n, spec.action.size), hidden'); see `policies.policy.Policy.act`.

        Where the recurrent state overflows, the action is NaN; the judge counts it as a bad action.
        """
        hidden = np.where(np.reshape(fresh, (-1, *[1] * len(self.hidden_shape))), 0, hidden)
        inputs = [np.asarray(x, np.float32) for x in (state, image, hidden)]
        if len(state) == self.rows == self.block:
            return _nan_if_overflowed(*self.model(*inputs))
        actions = np.empty((len(state), self.spec.action.size), np.float32)
        remembered = np.empty_like(inputs[2])
        for low in range(0, len(state), self.rows):
            used = slice(low, min(low + self.rows, len(state)))
            action, after = self.model(*(self._padded(x[used]) for x in inputs))
            actions[used] = action[: used.stop - low]
            remembered[used] = after[: used.stop - low]
        return _nan_if_overflowed(actions, remembered)

    def _padded(self, rows: np.ndarray) -> np.ndarray:
        if len(rows) == self.block:
            return rows
        block = np.zeros((self.block, *rows.shape[1:]), np.float32)
        block[: len(rows)] = rows
        return block


def proven(policy: BlockPolicy, where: str) -> BlockPolicy:
    """Test a loaded model, and return a policy whose rows do not influence each other.

    The test runs a block of random rows twice; then some of its rows, each repeated to fill a
    block, and each among zeros. If a row's output changes by rounding, the returned policy runs one
    row at a time.

    Args:
        policy: as loaded.
        where: the file, for messages.

    Raises:
        PolicyError: where the outputs have wrong shapes, the same inputs give different outputs, or
            an output depends on the other rows by more than rounding.
    """
    rng = np.random.default_rng(0)
    n = policy.block
    state, image, hidden = _drawn(policy, rng)
    first = policy.model(state, image, hidden)
    expected = ((n, policy.spec.action.size), (n, *policy.hidden_shape))
    for name, value, shape in zip(("action", "hidden"), first, expected, strict=True):
        if value.shape != shape or value.dtype != np.float32:
            raise PolicyError(
                f"{where}: output {name!r} is {value.dtype} {value.shape} for {n} rows, expected "
                f"float32 {shape}; see docs/policies.md"
            )
    if not _same(first, policy.model(state, image, hidden)):
        raise PolicyError(
            f"{where}: the same inputs gave two outputs; export the policy in evaluation mode, "
            "without dropout and sampling"
        )
    one_by_one = False
    for row in rng.choice(n, min(n, 8), replace=False):
        everywhere = (np.repeat(x[row : row + 1], n, 0) for x in (state, image, hidden))
        wanted = tuple(np.repeat(x[row : row + 1], n, 0) for x in first)
        among_zeros = (np.where(np.arange(n).reshape(-1, *[1] * (x.ndim - 1)) == row, x, 0)
                       for x in (state, image, hidden))  # fmt: skip
        alone = tuple(x[row : row + 1] for x in policy.model(*among_zeros))
        for found in (policy.model(*everywhere), alone):
            _refuse_batch_dependence(tuple(x[: len(found[0])] for x in wanted), found, where)
            one_by_one |= not _same(tuple(x[: len(found[0])] for x in wanted), found)
    return dataclasses.replace(policy, rows=1) if one_by_one else policy


def _refuse_batch_dependence(
    wanted: tuple[np.ndarray, ...], found: tuple[np.ndarray, ...], where: str
) -> None:
    """Refuse outputs that depend on the other rows by more than rounding, as with BatchNorm."""
    for expected, value in zip(wanted, found, strict=True):
        size = max(1.0, float(np.abs(expected).max(initial=0.0)))
        apart = float(np.abs(value - expected).max(initial=0.0))
        if apart > ROUNDING * size:
            raise PolicyError(
                f"{where}: a row's output changes by {apart:.2g} with the other rows of its batch; "
                "a layer takes statistics over the batch (BatchNorm in training mode): call "
                "module.eval() before the export"
            )


def for_one_row(policy: BlockPolicy) -> BlockPolicy:
    """Return a faster policy for one vehicle, whose blocks have one row.

    The policy is returned unchanged where its model refuses one row or gives different outputs.
    Rounding differs from that in a block, so the judge does not use this.
    """
    inputs = _drawn(policy, np.random.default_rng(0))
    wanted = policy.model(*inputs)
    try:
        found = policy.model(*(x[:1] for x in inputs))
    except NoAnswer:
        return policy
    same = all(
        value.shape == block[:1].shape
        and np.allclose(value, block[:1], 0.0, ROUNDING * max(1.0, np.abs(block).max(initial=0.0)))
        for value, block in zip(found, wanted, strict=True)
    )
    return dataclasses.replace(policy, block=1, rows=1) if same else policy


def _drawn(
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
    lost = ~np.asarray(np.isfinite(hidden).all(axis=tuple(range(1, hidden.ndim))))
    if lost.any():
        action = np.where(lost[:, None], np.float32(np.nan), action)
    return action, hidden


def _same(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> bool:
    return all(a.tobytes() == b.tobytes() for a, b in zip(one, other, strict=True))
