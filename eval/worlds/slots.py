"""Parts that the simulators ("worlds") with slots share: scenes, gates and random numbers."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from eval.quadrotor.autopilot import make_autopilot
from eval.quadrotor.plant import uses_noise
from eval.vehicles.vehicle import Vehicle
from eval.worlds.trial import Course, Rules, TrialSpec
from policies.spec import ActionSpec
from tracks.common.masks import select, take
from tracks.families import MAX_COUNTS
from tracks.geometry.camera import Camera
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


class Slots:
    """Scenes, gates and gusts of N slots, which the simulators with slots share."""

    actions = ("ctbr", "motors")
    dtype: Any = np.float64
    """Type of the numbers of scenes and gusts."""
    _course: Course

    def __init__(
        self,
        vehicle: Vehicle,
        camera: Camera,
        layout: Layout,
        rules: Rules,
        slots: int,
        threads: int = 1,
        action: ActionSpec | None = None,
    ) -> None:
        """Make the slots.

        Every track fits the padded sizes of `layout`. Results do not depend on the threads for
        physics. The policy's action is by default an acceleration.
        """
        self.slots = slots
        self._camera, self._layout, self._rules, self._threads = camera, layout, rules, threads
        self._autopilot = make_autopilot(vehicle, action)
        self.dt = self._autopilot.dt
        self._gate_count = np.ones(slots, np.int32)
        self._scene: Scene | None = None
        self._gusts: list[GustDraws] | None = None
        if uses_noise(self._autopilot.plant):
            self._gusts = [GustDraws(IDLE)] * slots

    def _insert(self, entries: list[tuple[int, Track, TrialSpec]], meshes: bool) -> np.ndarray:
        """Store the scenes, gates and gusts of new trials; return which slots have one, (N,) bool.

        Without `meshes` they are left out of the scenes. Slots without a trial get any scene.
        """
        slots, scenes = [slot for slot, _, _ in entries], []
        for slot, track, trial in entries:
            self._gate_count[slot] = len(track.scene.gates.center_w)
            if self._gusts is not None:
                self._gusts[slot] = GustDraws(trial)
            gates = pad_gates(track.scene.gates, self._layout.gates, self._layout.corners)
            triangles = track.scene.triangles[: None if meshes else 0]
            scenes.append(track.scene._replace(gates=gates, triangles=triangles))
        solids = self._layout.solids if meshes else self._layout.solids._replace(triangles=0)
        number, started = np.zeros(self.slots, int), np.zeros(self.slots, bool)
        number[slots], started[slots] = np.arange(len(slots)), True
        new = take(stack(scenes, solids, self.dtype), number)
        self._scene = select(started, new, self._scene or new)
        self._course = Course(self._scene.gates, self._gate_count)
        return started

    def _draws(self, step: np.ndarray, count: int) -> np.ndarray | None:
        """Return the draws (count, N, 3) of the gusts for the steps from `step` (N,) on, if any."""
        if self._gusts is None:
            return None
        pairs = zip(step.tolist(), self._gusts, strict=True)
        return np.stack([draws.at(k, count) for k, draws in pairs], axis=1).astype(
            self.dtype, copy=False
        )

    def _draws_at(self, step: np.ndarray) -> np.ndarray | None:
        """Return the draws (N, 3) of the gusts for one step (N,); 0 is the start."""
        draws = self._draws(step, 1)
        return None if draws is None else draws[0]
