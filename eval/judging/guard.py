"""Call a policy, and check and limit its actions before the judge or an environment flies them."""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.vehicles.vehicle import Vehicle
from policies.policy import Hidden, Policy, checked_act
from policies.spec import ActionSpec, NoAnswer


@dataclass(frozen=True)
class ActionLimits:
    """Limits of a policy's actions."""

    size: float = 50.0
    """Largest norm of an acceleration [m/s^2]; larger ones are scaled down to it. It exceeds what a
    thrust of five times the weight can give, so that it affects only faulty outputs."""
    deadline_s: float | None = None
    """Time limit for the policy's output [s]; a late output is not flown, and its trials end by
    timeout. None: no limit. With a limit, outcomes depend on the machine's load."""
    action: ActionSpec = field(default_factory=ActionSpec)
    """The policy's kind of action."""
    low: tuple[float, ...] = ()
    """Smallest value of each component of other actions, in SI units; () for accelerations."""
    high: tuple[float, ...] = ()
    """Largest value of each component of other actions, in SI units; () for accelerations."""


def limits_of(limits: ActionLimits, action: ActionSpec, vehicle: Vehicle) -> ActionLimits:
    """Return `limits` with `low` and `high` for a kind of action, from the vehicle file."""
    low, high = (), ()
    if action.kind == "ctbr":
        rate = vehicle.controller.rate_max
        low, high = (0.0, *(-largest for largest in rate)), (vehicle.full_thrust, *rate)
    elif action.kind == "motors":
        low, high = (0.0,) * 4, (1.0,) * 4
    return replace(limits, action=action, low=low, high=high)


def check_rate(name: str, rate_hz: float, physics_hz: float) -> None:
    """Raise a ValueError if `name` decides more often than the physics makes steps."""
    if not 0 < rate_hz <= physics_hz * (1 + 1e-9):
        raise ValueError(
            f"{name} decides at {rate_hz:g} Hz; allowed is more than 0 and up to the "
            f"{physics_hz:g} Hz of the physics (the vehicle's controller.frequency)"
        )


def first_action(action: ActionSpec, vehicle: Vehicle) -> np.ndarray:
    """Return the action of a hover (size,) in SI units.

    When a trial starts, the policy gets it as its last action.
    """
    if action.kind == "acceleration":
        return np.zeros(3)
    if action.kind == "ctbr":
        return np.array([GRAVITY, 0.0, 0.0, 0.0])
    thrust_share = np.full(4, GRAVITY / vehicle.full_thrust)
    return np.sqrt(thrust_share) if action.motors == "speed" else thrust_share


class Guarded(NamedTuple):
    """Checked actions, and their faults."""

    action_b: np.ndarray
    """(N, size) actions to fly, in SI units, float64."""
    bad: np.ndarray
    """(N,) bool, whether the action was not finite and is replaced by the last flown action."""
    limited: np.ndarray
    """(N,) bool, whether the action was scaled down to the limit, or a component was clipped."""
    late: np.ndarray
    """(N,) bool, whether the action was late or missing and is replaced by the last flown one."""
    largest: np.ndarray
    """(N,) largest absolute component of the policy's raw output; NaN if bad."""
    missing: str = ""
    """Why the policy gave no output, if it gave none."""


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

    A policy computes the actions of all N trials at once, so a late or missing output is late for
    all of them. The hidden state is then unchanged.

    Args:
        limits: limits of the actions.
        policy: the policy; the next arguments are those of `policies.policy.Policy.act`.
        hidden: its hidden state.
        state: (N, spec.state_size) state observations.
        image: (N, height, width) encoded depth images.
        fresh: (N,) bool, rows in which a new trial starts.
        last_b: (N, size) last flown actions in SI units; at the start, `first_action`.

    Raises:
        ValueError: where the output is not an array of actions and a hidden state.
    """
    start_s = time.perf_counter()
    try:
        output, next_hidden = checked_act(policy, hidden, state, image, fresh)
    except NoAnswer as error:
        none = np.zeros(len(last_b), bool)
        # A worker process loads a copy of the file, whose path does not help the user.
        text = str(error).partition(f"{policy.name}: ")[2] or str(error)
        text = f"policy {policy.name!r} gave no action: {text}"
        return Guarded(last_b, none, none, ~none, np.full(len(last_b), np.nan), text), hidden
    took_s = time.perf_counter() - start_s
    return guard_action(limits, output, last_b, took_s, policy.name), next_hidden


def guard_action(
    limits: ActionLimits, action_b: object, last_b: np.ndarray, took_s: float, policy: str
) -> Guarded:
    """Check and limit the actions that a policy returned.

    The policy's output should be (N, size) real numbers, computed in `took_s` [s]. `last_b` (N,
    size) are the last flown actions in SI units; at the start, `first_action`.

    Raises:
        ValueError: where the shape or type of `action_b` is wrong.
    """
    action = np.asarray(action_b)
    if action.shape != last_b.shape or action.dtype.kind not in "fiu":
        raise ValueError(
            f"policy {policy!r} returned actions of shape {action.shape} and type {action.dtype}; "
            f"expected real numbers of shape {last_b.shape}: one {limits.action.kind} for each row "
            "of its input. Check the policy's output."
        )
    finite = np.isfinite(action).all(1)
    largest = np.where(finite, np.abs(action).max(1), np.nan).astype(np.float64)
    action = np.asarray(limits.action.to_si(action)).astype(np.float64)
    late = np.full(len(action), limits.deadline_s is not None and took_s > limits.deadline_s)
    bad = ~(finite & np.isfinite(action).all(1)) & ~late
    action = np.where((bad | late)[:, None], last_b, action)
    if limits.high:
        clipped = np.clip(action, limits.low, limits.high)
        return Guarded(clipped, bad, (clipped != action).any(1), late, largest)
    # Scaled before squaring, so that the norm of a very large action does not overflow.
    scale = np.abs(action).max(1, keepdims=True)
    scaled = action / np.maximum(scale, 1e-30)
    norm = scale[:, 0] * np.sqrt((scaled * scaled).sum(1))
    limited = norm > limits.size
    reduced = scaled * (limits.size / np.sqrt(np.maximum((scaled * scaled).sum(1), 1e-30)))[:, None]
    return Guarded(np.where(limited[:, None], reduced, action), bad, limited, late, largest)
