"""Least time within limits: proximal steps on linearised limits, with penalties beyond them.

A step goes to where the time, linear, and the squares of the limits' excess, each limit linear, are
least together within reach (Lewis and Wright 2016, A proximal method for composite minimization);
the limits that such a step would come to break count in it as those that are broken already.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from tracks.geometry.scene import Array

DAMPING, LEAST_DAMPING, MOST_DAMPING = 0.1, 1e-7, 1e6
"""At the start, and its bounds."""
TAKEN, REFUSED = 1 / 3, 4.0
"""What it is multiplied by after a step that is taken, and after one that is not."""
MOST = 3.0
"""By which a number changes in a step [m or s]."""
LEAST_REACH = 1e-2
"""Of a change of every number by itself."""
FELT = 10.0
"""Of a path's acceleration, what a step of a search feels as 1 [m/s^2]."""
SMOOTH = 0.02
"""Weight of a path's control points' third differences, where nothing else says where they are."""
LOOKS = 6
"""Guesses, each from the one before, which limits a step breaks."""


class Judged(NamedTuple):
    """What an attempt comes to."""

    time_s: Array
    """() what is to be least [s]."""
    excess: Array
    """(L,) of each limit, in units of what is tolerated; none where it is not positive."""
    off: Array
    """(R,) what is to be zero, in units of what is tolerated."""
    felt: Array
    """(M,) what a step should change by little: its squared change is what reach is measured by."""


class Search(NamedTuple):
    """Where N searches stand."""

    numbers: Array
    """(N, n) the best so far."""
    cost: Array
    """(N,)."""
    damping: Array
    """(N,)."""


Problem = Callable[[Array, Any], Judged]
"""(numbers (n,), the rest of one search) -> what they come to."""


def cost_of(judged: Judged) -> Array:
    """Return the time and half the squares of what is broken."""
    over = jnp.maximum(judged.excess, 0.0)
    return judged.time_s + 0.5 * ((over**2).sum(-1) + (judged.off**2).sum(-1))


def begin(numbers: Array, judged: Judged) -> Search:
    """Return N searches at `numbers` (N, n), which come to `judged` (N, ...)."""
    cost = cost_of(judged)
    return Search(jnp.asarray(numbers), cost, jnp.full(cost.shape, DAMPING))


def step(problem: Problem, search: Search, rest: Any) -> Search:
    """Return N searches after one step each, taken where it lowers the cost."""

    def towards(numbers: Array, damping: Array, rest: Any) -> Array:
        judged, push = jax.linearize(lambda z: problem(z, rest), numbers)
        slope = jax.vmap(push)(jnp.eye(numbers.shape[0]))
        reach = slope.felt @ slope.felt.T + LEAST_REACH * jnp.eye(numbers.shape[0])
        always = slope.off @ slope.off.T + damping * reach
        pull = slope.time_s + slope.off @ judged.off

        def look(change: Array, _: None) -> tuple[Array, None]:
            broken = judged.excess + change @ slope.excess > 0.0
            some = slope.excess * broken
            hessian = always + some @ some.T
            return -jnp.linalg.solve(hessian, pull + some @ judged.excess), None

        change, _ = jax.lax.scan(look, jnp.zeros_like(numbers), length=LOOKS)
        return numbers + change * jnp.minimum(1.0, MOST / jnp.abs(change).max())

    tried = jax.vmap(towards)(search.numbers, search.damping, rest)
    judged = jax.vmap(problem)(tried, rest)
    cost = cost_of(judged)
    good = cost < search.cost  # false for what is no number
    damping = jnp.where(good, TAKEN * search.damping, REFUSED * search.damping)
    return Search(
        jnp.where(good[:, None], tried, search.numbers),
        jnp.where(good, cost, search.cost),
        jnp.clip(damping, LEAST_DAMPING, MOST_DAMPING),
    )
