"""Call a policy, and check and limit its output before it is flown."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.vehicles.vehicle import Vehicle
from policies.policy import Hidden, Policy
from policies.spec import ActionSpec, NoAnswer


@dataclass(frozen=True)
class ActionLimits:
    """Limits of actions."""

    size: float = 50.0
    """Largest |action_b| of an acceleration [m/s^2]; larger ones are reduced to it. It exceeds the
    net acceleration of a thrust-to-weight ratio of 5, so that it affects only faulty outputs."""
    deadline_s: float | None = None
    """Time limit of the policy's answer [s]; a late answer is not flown and ends its trials as
    timeout. None: no limit. With a limit, outcomes depend on the machine's load."""
    action: ActionSpec = field(default_factory=ActionSpec)
    """The policy's kind of action."""
    low: tuple[float, ...] = ()
    """Smallest value of each component in SI units, for other kinds of action than acceleration."""
    high: tuple[float, ...] = ()
    """Largest value of each component."""


def limits_of(limits: ActionLimits, action: ActionSpec, vehicle: Vehicle) -> ActionLimits:
    """Return `limits` for a policy's kind of action; commands have the vehicle file's limits."""
    low, high = (), ()
    if action.kind == "ctbr":
        rate = vehicle.controller.rate_max
        low, high = (0.0, *(-most for most in rate)), (vehicle.full_thrust, *rate)
    elif action.kind == "motors":
        low, high = (0.0,) * 4, (1.0,) * 4
    return replace(limits, action=action, low=low, high=high)


def first_action(action: ActionSpec, vehicle: Vehicle) -> np.ndarray:
    """Return the last action at the start of a trial, (size,) in SI units: hovering."""
    if action.kind == "acceleration":
        return np.zeros(3)
    if action.kind == "ctbr":
        return np.array([GRAVITY, 0.0, 0.0, 0.0])
    share = np.full(4, GRAVITY / vehicle.full_thrust)
    return np.sqrt(share) if action.motors == "speed" else share


class Guarded(NamedTuple):
    """Checked actions, and their faults."""

    action_b: np.ndarray
    """(N, size) float64, SI units; (N, 3) [m/s^2] of an acceleration."""
    bad: np.ndarray
    """(N,) bool: not finite, replaced by the last good action."""
    limited: np.ndarray
    """(N,) bool: reduced to the limit, or a component clipped."""
    late: np.ndarray
    """(N,) bool: late or missing, replaced by the last good action."""
    largest: np.ndarray
    """(N,) largest absolute component of the policy's raw output; NaN if bad."""


def call_policy(
    limits: ActionLimits,
    policy: Policy,
    hidden: Hidden,
    state: np.ndarray,
    image: np.ndarray,
    fresh: np.ndarray,
    last_b: np.ndarray,
) -> tuple[Guarded, Hidden]:
    """Call a policy once, and return its checked actions and the new hidden state.

    A policy answers for all N trials at once, so a late or missing answer is late for all of them.
    The hidden state is then unchanged.

    Args:
        limits: of actions.
        policy: to call; for its other arguments see `policies.policy.Policy.act`.
        hidden: its hidden state.
        state: (N, spec.state_size).
        image: (N, height, width).
        fresh: (N,) bool.
        last_b: (N, size) the action flown last in SI units, at first `first_action`.

    Raises:
        ValueError: where the answer is not an array of actions.
    """
    called = time.perf_counter()
    try:
        answer, after = policy.act(hidden, state, image, fresh)
    except NoAnswer:
        nothing = np.zeros(len(last_b), bool)
        return Guarded(last_b, nothing, nothing, ~nothing, np.full(len(last_b), np.nan)), hidden
    took_s = time.perf_counter() - called
    return guard_action(limits, answer, last_b, took_s, policy.name), after


def guard_action(
    limits: ActionLimits, action_b: object, last_b: np.ndarray, took_s: float, policy: str
) -> Guarded:
    """Check and limit what a policy returned.

    Args:
        limits: of actions.
        action_b: what the policy returned; should be (N, size) real numbers.
        last_b: (N, size) the action flown last in SI units, at first `first_action`.
        took_s: how long the answer took [s].
        policy: its name, for the message.

    Raises:
        ValueError: where the shape or kind of `action_b` is wrong.
    """
    action = np.asarray(action_b)
    if action.shape != last_b.shape or action.dtype.kind not in "fiu":
        raise ValueError(
            f"policy {policy!r} returned actions of shape {action.shape} and type {action.dtype}; "
            f"wanted real numbers of shape {last_b.shape}: one {limits.action.kind} for each row "
            "of its input. Check the policy's output."
        )
    largest = np.abs(action).max(1).astype(np.float64)
    finite = np.isfinite(action).all(1)
    action = np.asarray(limits.action.to_si(action)).astype(np.float64)
    late = np.full(len(action), limits.deadline_s is not None and took_s > limits.deadline_s)
    bad = ~(finite & np.isfinite(action).all(1)) & ~late
    action = np.where((bad | late)[:, None], last_b, action)
    if limits.high:
        inside = np.clip(action, limits.low, limits.high)
        return Guarded(inside, bad, (inside != action).any(1), late, largest)
    # Scaled before squaring, so that a huge finite action does not overflow to infinity.
    longest = np.abs(action).max(1, keepdims=True)
    unit = action / np.maximum(longest, 1e-30)
    size = longest[:, 0] * np.sqrt((unit * unit).sum(1))
    limited = size > limits.size
    shortened = unit * (limits.size / np.sqrt(np.maximum((unit * unit).sum(1), 1e-30)))[:, None]
    return Guarded(np.where(limited[:, None], shortened, action), bad, limited, late, largest)
