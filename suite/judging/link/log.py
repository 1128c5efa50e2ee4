"""Writes the log of a flight over the link, as the companion knows it.

A set point acts about when it is sent, some milliseconds after the state that it answers. So each
state and each set point has a row of its own, at its own time by the vehicle's clock. The shortest
delays of the link are unknown: `suite diagnose` finds them as a `command_delay`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eval.logs.columns import FlightLogError
from eval.logs.flight import Flight
from eval.logs.flight_log import log_from_flight, write_flight
from suite.common.console import Console
from suite.judging.link.companion import Companion, Row
from suite.judging.trials import log_name


def write_log(
    companion: Companion, about: dict[str, Any], out: Path, console: Console
) -> str | None:
    """Write a flight's log into `out` and return its name; None if it is no valid flight log.

    A flight with fewer than two states has none. `about` is stored in the log: track, level and
    seed, and of a simulated flight the integrator. `console` shows why a log is not written.
    """
    rows = companion.rows
    if len(rows) < 2:
        return None
    about = {**about, "events": companion.events, "handed_over": companion.over}
    about["command_jitter_s"] = round(command_jitter_s(rows), 6)
    name = log_name(about["track"], about["difficulty"], about["seed"])
    try:
        write_flight(out / name, log_from_flight(_flight_of(rows, about, companion.action_kind)))
    except FlightLogError as error:
        console.note(f"warning: the flight's log is not written: {error}")
        return None
    return name


def command_jitter_s(rows: list[Row]) -> float:
    """Return the standard deviation of the times at which set points act [s].

    It is that of the delays of states: both directions of a link are taken as alike. Half the range
    of two thirds of them is the same for normal delays, and a few long ones do not matter.
    """
    late_s = [row.sent_s - row.answered_s - row.state.time_s for row in rows]
    return float(np.diff(np.quantile(late_s, [0.16, 0.84])).item() / 2.0)


def _flight_of(rows: list[Row], about: dict[str, Any], action_kind: str) -> Flight:
    """Return the flight with rows of states and of set points; NaN is where a row has no value.

    Actions and gates are those of the latest state.
    """
    state_s = np.array([row.state.time_s - rows[0].state.time_s for row in rows])
    sent_s = np.array([row.sent_s - rows[0].state.time_s for row in rows])
    sent_s = np.maximum(sent_s, state_s)  # rounding
    # What was sent after the last state has no effect on the log.
    sent = np.flatnonzero(sent_s <= state_s[-1])
    time_s, place = np.unique(np.concatenate([state_s, sent_s[sent]]), return_inverse=True)
    of_state, of_sent = place[: len(rows)], place[len(rows) :]

    def column(values: list[Any], at: np.ndarray, of: Any = slice(None)) -> np.ndarray:
        """Return the `values` at `of` in the rows `at`, and NaN in the others."""
        known = np.array(values)[of]
        every = np.full((len(time_s), *known.shape[1:]), np.nan)
        every[at] = known
        return every

    states = [row.state for row in rows]
    latest = np.searchsorted(state_s, time_s, side="right") - 1
    return Flight(
        time_s=time_s,
        pos_w=column([state.pos_w for state in states], of_state),
        quat_wxyz=column([state.quat_wxyz for state in states], of_state),
        vel_w=column([state.vel_w for state in states], of_state),
        rate_b=column([state.rate_b for state in states], of_state),
        thrust_cmd=column([row.thrust for row in rows], of_sent, sent),
        rate_cmd_b=column([row.rate_b for row in rows], of_sent, sent),
        rotor_speed=np.full((len(time_s), 4), np.nan),
        action_b=np.stack([row.action_b for row in rows])[latest],
        policy_step=column([row.decided for row in rows], of_state) == 1.0,
        gate=np.array([row.gate for row in rows], np.int32)[latest],
        depth_m=None,
        depth_time_s=None,
        about=about,
        action_kind=action_kind,
    )
