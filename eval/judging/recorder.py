"""Record the flights of trials while the judge flies them; each slot records its own flight."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.logs.flight import Flight
from eval.worlds import Rows

_EMPTY = [np.zeros(size) for size in ((), 3, 4, 3, 3, (), 3, 4, ())]
"""A row of zeros with the shapes of the fields of `Rows` after `due`, for the columns of an empty
flight; a flight is empty if its trial ended at the start."""


class Recorder:
    """Collects the rows of the flights in N slots, and returns a slot's flight at its end."""

    def __init__(self, slots: int, depth: bool, first: np.ndarray, action_kind: str) -> None:
        """Make a recorder.

        Depth images take 3 kB each at 24 x 32 pixels. The action `first` (size,) is recorded before
        the first decision.
        """
        self._depth, self._action_kind = depth, action_kind
        self._rows: list[list[tuple[Any, ...]]] = [[] for _ in range(slots)]
        self._images: list[list[tuple[float, np.ndarray]]] = [[] for _ in range(slots)]
        self._first = first
        self._action = np.tile(self._first, (slots, 1))
        self._is_new = np.zeros(slots, bool)

    def start(self, slot: int) -> None:
        """Begin the flight of a new trial in `slot`."""
        self._rows[slot], self._images[slot] = [], []
        self._is_new[slot] = False
        self._action[slot] = self._first

    def decided(
        self, slots: np.ndarray, time_s: np.ndarray, action_b: np.ndarray, depth_m: np.ndarray
    ) -> None:
        """Store times, actions and depth images of new decisions, (N, ...) each, for `slots` (k,).

        The time (N,) is that of the decision; the next row of a flight is up to 10 ms later.
        """
        for slot in slots:
            self._action[slot] = action_b[slot]
            self._is_new[slot] = True
            if self._depth:
                image = depth_m[slot].astype(np.float32)
                self._images[slot].append((float(time_s[slot]), image))

    def add(self, rows: Rows) -> None:
        """Add one row to the flight of each slot that is recorded at this step (`rows.due`)."""
        for slot in np.flatnonzero(rows.due):
            values = (np.copy(field[slot]) for field in rows[1:])
            self._rows[slot].append((*values, self._action[slot].copy(), bool(self._is_new[slot])))
            self._is_new[slot] = False

    def finish(self, slot: int, about: dict[str, Any]) -> Flight:
        """Return the flight in `slot`, with `about` as its metadata."""
        rows = self._rows[slot] or [(*_EMPTY, self._first, False)]
        columns = [np.array(column) for column in zip(*rows, strict=True)]
        if not self._rows[slot]:
            columns = [column[:0] for column in columns]
        *states, gate, action, is_new = columns
        depth: tuple[Any, Any] = None, None
        if self._depth:
            times_s = np.array([time_s for time_s, _ in self._images[slot]])
            images = [image for _, image in self._images[slot]]
            depth = np.stack(images) if images else np.zeros((0, 0, 0), np.float32), times_s
        gate = gate.astype(np.int32)
        values: Any = (*states, action, is_new, gate, *depth, about, self._action_kind)
        return Flight(*values)
