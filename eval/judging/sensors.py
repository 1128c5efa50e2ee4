"""Sensor models in the slots of a judge, with each trial's own draws.

What they change is in the policy's observation alone: the autopilot below it, its heading included,
and the judge see the truth. Everything random is drawn from the trial's own seed, model by model,
in an order that nothing else can change, so a trial's outcome stays set by the trial.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from eval import sensors
from eval.sensors import SENSORS
from eval.sensors.draws import blank_of_each, draw
from eval.sensors.sensors_file import SensorSet
from eval.worlds.slots import SENSED, generator_of
from eval.worlds.trial import TrialSpec
from policies.observation import View
from tracks.common.masks import select, take
from tracks.geometry.camera import Camera


class Sensors:
    """The sensors of N slots, with the errors of the trial that flies in each."""

    def __init__(self, wanted: SensorSet, slots: int, rate_hz: float, camera: Camera) -> None:
        """Make the sensors.

        Args:
            wanted: which models.
            slots: how many trials fly at once.
            rate_hz: observations a second [Hz].
            camera: the policy's.
        """
        self._models, self._dt_s, self._camera = sensors.sensing(wanted.models), 1 / rate_hz, camera
        used = (SENSORS[name] for name in self._models)
        self._trial, self._draws = blank_of_each(used, slots, camera)
        nobody = np.random.default_rng(0)
        self._generators = {name: [nobody] * slots for name in self._models}
        self._memory: dict[str, Any] | None = None

    def start(self, slot: int, trial: TrialSpec) -> None:
        """Begin `trial` in `slot`."""
        for name, generators in self._generators.items():
            generators[slot] = generator_of(trial, SENSED, name)
            draw(self._trial[name], slot, generators[slot])

    def see(self, truth: View, fresh: np.ndarray, flying: np.ndarray) -> View:
        """Return what the sensors show, whose errors walk on; call it once an observation.

        Args:
            truth: what there is to see in each slot, with the gates' numbers.
            fresh: (N,) bool, slots whose trial begins.
            flying: (N,) bool, the slots that fly; the others' rows stay as they are.
        """
        rows = np.flatnonzero(flying)
        for name, generators in self._generators.items():
            for slot in rows.tolist():
                draw(self._draws[name], slot, generators[slot])
        if not len(rows):
            return truth
        # What lies in an empty slot is no flight, and sensors are made for flights.
        whole = take(truth, np.where(flying, np.arange(len(flying)), rows[0]))
        models, about, memory = self._models, (self._dt_s, self._camera), self._memory
        if memory is None or fresh.any():
            begun = sensors.start(models, whole, self._trial, *about)
            memory = begun if memory is None else select(fresh, begun, memory)
        seen, self._memory = sensors.sense(models, memory, whole, self._draws, *about)
        return select(flying, seen, truth)
