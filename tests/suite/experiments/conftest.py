"""Flights of the documents, cut short: a fifth of a second a trial, a few at a time."""

from dataclasses import replace

import pytest

from eval.worlds.trial import Rules
from suite.experiments.study import judging


class Sky:
    """Counts the trials that are flown, and stops at a given one."""

    def __init__(self, monkeypatch):
        self.flown = []
        self.stop_after = None
        self._fly = judging.fly_share
        monkeypatch.setattr(judging, "fly_share", self.fly)
        monkeypatch.setattr(judging, "usable_cores", lambda: 1)

    def fly(self, task, share):
        options = replace(task.options, slots=8, rules=Rules(time_limit_s=0.2))
        for index, result, flight in self._fly(replace(task, options=options), share):
            self.flown.append((task.policy.name, task.vehicle, options.sensors, result.trial))
            yield index, result, flight
            if self.stop_after == len(self.flown):
                self.stop_after = None
                raise KeyboardInterrupt


@pytest.fixture
def sky(monkeypatch):
    return Sky(monkeypatch)
