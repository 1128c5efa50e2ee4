"""Policies for tests of the judge: one that flies by the state alone, one with a real network."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from policies.spec import PolicySpec


@dataclass
class Pursuit:
    """Steers the velocity towards the next gate's centre; sees no obstacle."""

    speed: float = 4.0
    gain: float = 3.0
    spec: PolicySpec = field(default_factory=PolicySpec)
    name: str = "pursuit"

    def start(self, n):
        return np.zeros((n, 3), np.float32)

    def act(self, hidden, state, image, fresh):
        vel, gate = state[:, :3], state[:, 6:9]
        hidden = np.where(fresh[:, None], np.float32(0), hidden)
        distance = np.sqrt((gate * gate).sum(-1, keepdims=True))
        ahead = gate / np.maximum(distance, 1e-3)
        # Close to the centre its direction swings round; fly straight on instead.
        flat = np.sqrt((vel * vel).sum(-1, keepdims=True))
        ahead = np.where((distance < 0.4) & (flat > 1), vel / np.maximum(flat, 1e-3), ahead)
        action = self.gain * (self.speed * ahead - vel)
        return np.clip(action, -12, 12).astype(np.float32), hidden


@dataclass
class Scripted:
    """Wants one acceleration in body axes after the other, then goes on with the last."""

    actions_b: np.ndarray
    spec: PolicySpec = field(default_factory=PolicySpec)
    name: str = "scripted"

    def start(self, n):
        return np.zeros((n, 1), np.float32)

    def act(self, hidden, state, image, fresh):
        done = np.where(fresh[:, None], np.float32(0), hidden)
        which = np.minimum(done[:, 0].astype(int), len(self.actions_b) - 1)
        return self.actions_b[which].astype(np.float32), done + np.float32(1)


@dataclass
class Steady(Scripted):
    """Always gives the same action."""

    actions_b: Any = (0.0, 0.0, 0.0)
    name: str = "steady"

    def __post_init__(self):
        self.actions_b = np.atleast_2d(self.actions_b)


class Watcher:
    """Keeps what a pilot is given and what it answers."""

    def __init__(self, pilot):
        self.pilot, self.spec, self.name = pilot, pilot.spec, pilot.name
        self.start, self.given, self.answers_b = pilot.start, [], []

    def act(self, hidden, state, image, fresh):
        self.given.append((state.copy(), image.copy()))
        action_b, hidden = self.pilot.act(hidden, state, image, fresh)
        self.answers_b.append(action_b[0])
        return action_b, hidden


class RandomNetwork:
    """The CNN-GRU of the policies with random parameters, on top of a pursuit so that it flies."""

    name = "random-network"

    def __init__(self, seed=0, share=3.0):
        import jax

        from policies.block_policy import verify_rows
        from policies.native import native_policy
        from policies.networks.network import init

        self.spec = PolicySpec()
        params = init(jax.random.key(seed), self.spec)
        params["action.weight"] *= 100.0
        policy = replace(native_policy(params, self.spec, self.name), block=8, rows=8)
        self._network = verify_rows(policy, "test")
        self._pursuit = Pursuit()
        self._share = share

    def start(self, n):
        return self._network.start(n)

    def act(self, hidden, state, image, fresh):
        extra, hidden = self._network.act(hidden, state, image, fresh)
        action, _ = self._pursuit.act(np.zeros((len(state), 3)), state, image, fresh)
        return action + np.float32(self._share) * np.tanh(extra), hidden


random_network = cache(RandomNetwork)  # compiled once for all tests
