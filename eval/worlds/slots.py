"""Parts that the simulators ("worlds") with slots share: scene sizes, gates and random numbers.

A slot flies one trial at a time, which is a flight along a track.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from eval.worlds.trial import TrialSpec
from tracks.common.masks import select, take
from tracks.families import MAX_COUNTS
from tracks.geometry.scene import Counts, Gates, Scene, counts, stack
from tracks.track import Track


class Layout(NamedTuple):
    """Sizes to which all scenes are padded, so that any trial fits any slot."""

    solids: Counts
    """Number of solids of each kind."""
    gates: int
    """Number of gates."""
    corners: int
    """Number of corners of a gate's opening."""


def layout_of(tracks: Iterable[Track]) -> Layout:
    """Return the smallest layout that fits all `tracks` and all tracks of the families."""
    layout = Layout(MAX_COUNTS, 8, 4)
    for track in tracks:
        opening = track.scene.gates.opening_g
        solids = (max(pair) for pair in zip(counts(track.scene), layout.solids, strict=True))
        layout = Layout(
            Counts(*solids),
            max(layout.gates, opening.shape[0]),
            max(layout.corners, opening.shape[1]),
        )
    return layout


def slot_groups(trials: Sequence[TrialSpec], tracks: Mapping[str, Track]) -> list[list[int]]:
    """Return groups of trials, by their index, that can share slots.

    The size of a MuJoCo model depends on its meshes, so a track with meshes has its own group.
    `tracks` are those from files, by name.
    """
    groups: dict[str, list[int]] = {}
    for number, trial in enumerate(trials):
        track = tracks.get(trial.track)
        groups.setdefault(trial.track if track and track.mesh_sizes else "", []).append(number)
    return list(groups.values())


def insert_scenes(
    before: Scene | None,
    scenes: Sequence[Scene],
    slots: Any,
    started: np.ndarray,
    layout: Layout,
    dtype: Any,
) -> Scene:
    """Return the padded scenes of all N slots, with `scenes` in `slots`, which `started` (N,) bool.

    The other slots keep their scene of `before`; at first (None) they get the first of `scenes`.
    """
    padded = [
        scene._replace(gates=pad_gates(scene.gates, layout.gates, layout.corners))
        for scene in scenes
    ]
    number = np.zeros(len(started), int)
    number[slots] = np.arange(len(slots))
    new = take(stack(padded, layout.solids, dtype), number)
    return select(started, new, before or new)


def pad_gates(gates: Gates, number: int, corners: int) -> Gates:
    """Return `gates` padded to `number` gates with `corners` corners, by repeating the last one."""
    missing_corners = corners - gates.opening_g.shape[1]
    opening = np.concatenate(
        [gates.opening_g, np.repeat(gates.opening_g[:, -1:], missing_corners, 1)], 1
    )
    index = np.minimum(np.arange(number), len(gates.center_w) - 1)
    return Gates(*(field[index] for field in gates._replace(opening_g=opening)))


GUSTS, SENSED, STATE_AGES, IMAGE_AGES = range(1, 5)
"""Uses of a trial's random numbers; each has its own random generator."""
GUSTS_AT_ONCE = 1024
"""Number of steps whose draws are generated together."""
IDLE = TrialSpec("", 0, 0)
"""Trial of a slot before the first load."""


def generator_of(trial: TrialSpec, use: int, part: str = "") -> np.random.Generator:
    """Return the random generator of a trial for one use, which these arguments determine.

    Of a track file only the name counts, without the folder. The use is one of `GUSTS`, `SENSED`,
    `STATE_AGES` and `IMAGE_AGES`. Each `part` of it, such as a sensor model, has its own generator.
    """
    name = PurePath(trial.track).name
    key = [trial.seed, trial.difficulty, *name.encode(), use, *part.encode()]
    return np.random.default_rng(np.random.SeedSequence(key))


class GustDraws:
    """Standard normal draws for a trial's gusts, generated during the flight.

    The trial determines them. The draws of one hour at 10 kHz would need 0.9 GB at once.
    """

    def __init__(self, trial: TrialSpec) -> None:
        """Prepare the draws of `trial` from its first step on."""
        self._trial = trial
        self._rewind()

    def _rewind(self) -> None:
        self._generator = generator_of(self._trial, GUSTS)
        self._first, self._rows = 0, np.zeros((0, 3))

    def at(self, step: int, count: int) -> np.ndarray:
        """Return the draws (count, 3) of the steps from `step` on.

        Steps are cheap in increasing order; a step before the last one generates all draws again.
        """
        if step < self._first:
            self._rewind()
        while self._first + len(self._rows) < step + count:
            passed = min(step - self._first, len(self._rows))
            new_rows = self._generator.standard_normal((GUSTS_AT_ONCE, 3))
            self._rows = np.concatenate([self._rows[passed:], new_rows])
            self._first += passed
        return self._rows[step - self._first :][:count]
