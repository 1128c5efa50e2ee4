"""One recorded flight as plain arrays, for the flight log and the viewer."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Flight(NamedTuple):
    """One flight, sampled at every period of the attitude loop (100 Hz by default).

    For a policy of kind `ctbr` there are also rows at its new commands.

    Row k holds what was measured at `time_s[k]` before the command of row k acts; that command
    holds until `time_s[k + 1]`. The last row is the state at the end of the trial; its command is
    the last one flown.
    """

    time_s: np.ndarray
    """(T,) increasing time, from 0 [s]."""
    pos_w: np.ndarray
    """(T, 3) position of the centre of mass in the world [m]."""
    quat_wxyz: np.ndarray
    """(T, 4) attitude, quaternion from body to world."""
    vel_w: np.ndarray
    """(T, 3) velocity of the centre of mass in the world [m/s]."""
    rate_b: np.ndarray
    """(T, 3) body rates [rad/s]."""
    thrust_cmd: np.ndarray
    """(T,) commanded collective thrust per nominal mass [m/s^2]."""
    rate_cmd_b: np.ndarray
    """(T, 3) commanded body rates [rad/s]."""
    rotor_speed: np.ndarray
    """(T, 4) rotor speeds in the vehicle file's order [rad/s]."""
    action_b: np.ndarray
    """(T, size) the policy's action in use, after the guard, in SI units; 3 accelerations, or the
    components of `action_kind`."""
    policy_step: np.ndarray
    """(T,) bool: the first row that flies a new action."""
    gate: np.ndarray
    """(T,) int32: the next gate's number from 0, equal to the number of gates passed."""
    depth_m: np.ndarray | None
    """(P, H, W) float32 depth images, one for each decision of the policy, or None."""
    depth_time_s: np.ndarray | None
    """(P,) time of each of these decisions; the attitude loop flies its action up to a row later
    [s]."""
    about: dict[str, Any]
    """Where the flight comes from: a row of trials.parquet (track, difficulty, seed, policy,
    vehicle, world, ended_by, ...) and how the world steps (integrator, step_s), as plain Python
    values; JSON can hold it."""
    action_kind: str = "acceleration"
    """Kind of action of the policy; `policies.spec.ACTIONS` has the names of its components."""
