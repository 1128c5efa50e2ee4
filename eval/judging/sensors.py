"""Apply sensor models (errors of the observed state and image) in the judge.

They change only the policy's observation; the autopilot, its commanded heading and the scoring use
the true state. All random numbers come from the trial's seed, model by model and in a fixed order,
so a trial's outcome depends on the trial only. A slot is a place in the simulator, in which one
trial (flight) is flown.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eval import sensors
from eval.sensors import SENSORS
from eval.sensors.draws import blank_model_draws, draw
from eval.sensors.sensors_file import SensorSet
from eval.worlds.slots import SENSED, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.common.masks import select, take
from tracks.geometry.camera import Camera


class Sensors:
    """The sensors of N slots, with the errors of the trial that flies in each slot."""

    def __init__(self, wanted: SensorSet, slots: int, rate_hz: float, camera: Camera) -> None:
        """Make the sensors of `slots` trials at once, observed at `rate_hz` [Hz]."""
        self._models = sensors.view_models(wanted.models)
        self._dt_s, self._camera = 1 / rate_hz, camera
        used = (SENSORS[name] for name in self._models)
        self._trial, self._draws = blank_model_draws(used, slots, camera)
        unused = np.random.default_rng(0)
        self._generators = {name: [unused] * slots for name in self._models}
        self._memory: dict[str, Any] | None = None

    def start(self, slot: int, trial: TrialSpec) -> None:
        """Begin `trial` in `slot`."""
        for name, generators in self._generators.items():
            generators[slot] = generator_of(trial, SENSED, name)
            draw(self._trial[name], slot, generators[slot])

    def see(self, truth: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return the view with sensor errors; call it once for each observation.

        The true views are (N, ...), with the number of the next gate. In `fresh` slots (N,) bool a
        trial begins. Slots that are not `flying` (N,) bool are returned unchanged.
        """
        rows = np.flatnonzero(flying)
        for name, generators in self._generators.items():
            for slot in rows.tolist():
                draw(self._draws[name], slot, generators[slot])
        if not len(rows):
            return truth
        # Views of empty slots are undefined; they are replaced by that of a flying slot.
        filled = take(truth, np.where(flying, np.arange(len(flying)), rows[0]))
        models, timing_and_camera = self._models, (self._dt_s, self._camera)
        memory = self._memory
        if memory is None or fresh.any():
            started = sensors.start(models, filled, self._trial, *timing_and_camera)
            memory = started if memory is None else select(fresh, started, memory)
        seen, self._memory = sensors.sense(models, memory, filled, self._draws, *timing_and_camera)
        return select(flying, seen, truth)
