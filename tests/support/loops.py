"""Loops made cheap: trials cut short, a stand-in for the gradient step, stops where asked for."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np

import eval.judging.judge
import suite.train.run
from eval.worlds.trial import Rules
from suite.loop import config as loop_config
from suite.loop.config import RECORDED_FROM
from suite.loop.options import Config
from tests.support.documents import unpainted


def resolve(**options):
    """Return the settings of a loop with these options."""
    return loop_config.resolve(Config(**options))


def made_update(trained, config, delta=None, begin=0):
    """Return a stand-in for the trainer's update, which appends what it got to `trained`."""
    numbers = {"loss": 1.0, "gates": 2.0, "collided": 0.5, "speed": 3.0}

    def update(state, worlds):
        # A lean that depends on the tracks and, with a correction, on that.
        push = 1e-3 * float(np.asarray(worlds.pos_w)[0, 0])
        if delta is not None:
            push += 1e-2 + float(np.ravel(delta[min(delta)])[0])
        params = jax.tree.map(lambda leaf: leaf + 1e-2 * push, state.params)
        trained.append((config, delta is not None, np.asarray(worlds.pos_w)))
        return state._replace(params=params, iteration=state.iteration + 1), numbers

    return update


class Small:
    """Makes a loop cheap, counts what it does, and stops it after a number of flights."""

    recorded_s = 1.4
    """Length of a flight that is recorded, a little more than a window of a fit [s]."""

    def __init__(self, monkeypatch, painted=False):
        self.flown, self.trained = [], []
        if not painted:
            unpainted(monkeypatch)
        self.stop_after: int | None = None
        self._fly = eval.judging.judge.fly
        monkeypatch.setattr(eval.judging.judge, "fly", self.fly)
        monkeypatch.setattr(suite.train.run, "make_update", partial(made_update, self.trained))

    def fly(self, policy, trials, vehicle, world, options, on_result, *rest, **more):
        # Only flights for the fits have such seeds, and have to be longer.
        seconds = self.recorded_s if trials[0].seed >= RECORDED_FROM else 0.2
        options = replace(options, slots=4, rules=Rules(time_limit_s=seconds))

        def keep(result, flight):
            on_result(result, flight)
            self.flown.append(result.trial)
            if len(self.flown) == self.stop_after:
                raise KeyboardInterrupt

        return self._fly(policy, trials, vehicle, world, options, keep, *rest, **more)
