"""A policy whose outputs and memory are recorded while it flies."""

from __future__ import annotations

import numpy as np

from policies.policy import Hidden, Policy, Wrapper
from policies.spec import Note

EXTREME, LEAST_DECISIONS = 0.999, 20
"""Share of an output's own largest size that counts as extreme; smallest number of decisions."""
OFTEN = 0.5
"""Share of extreme outputs above which the policy probably saturates."""


class Watched(Wrapper):
    """Flies as `policy` does, and keeps its outputs and whether its memory changes."""

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy)
        self._outputs: list[np.ndarray] = []
        self._has_memory = self._remembers = False

    def act(
        self, hidden: Hidden, state: np.ndarray, image: np.ndarray, fresh: np.ndarray
    ) -> tuple[np.ndarray, Hidden]:
        """Return what the policy's `act` returns."""
        output, new_hidden = super().act(hidden, state, image, fresh)
        self._outputs.append(np.array(output, float))
        if isinstance(hidden, np.ndarray) and hidden[~fresh].size:
            self._has_memory = True
            self._remembers |= not np.array_equal(new_hidden[~fresh], hidden[~fresh])
        return output, new_hidden

    def doubts(self) -> list[Note]:
        """Return a note if most outputs are at their component's own largest size."""
        outputs = np.abs(np.concatenate([*self._outputs, np.zeros((0, self.spec.action.size))]))
        largest = outputs.max(0, initial=0.0)
        if len(outputs) < LEAST_DECISIONS or not largest.min() > 0.0:  # also for NaN
            return []
        share = (outputs >= EXTREME * largest).mean()
        if share <= OFTEN:
            return []
        text = f"{share:.0%} of its outputs are at their own largest values"
        fix = "its last layer saturates or is constant: check the units and order of its inputs"
        return [Note("action_saturated", text, fix)]

    def hints(self) -> list[Note]:
        """Return a note if the policy has a memory that never changes."""
        if not self._has_memory or self._remembers:
            return []
        fix = "return the new memory as hidden_next, if it is recurrent"
        return [Note("memory_constant", "its memory never changes in flight", fix)]
