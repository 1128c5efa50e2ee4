"""What flights over the link came to: delays, deadlines, and the flight log of each."""

from __future__ import annotations

from typing import Any

import numpy as np

from eval.logs.flight import Flight
from eval.logs.flight_log import FlightLog, log_from_flight
from suite.judging.link.companion import Companion, Row


def delays(rows: list[Row], deadline_s: float) -> dict[str, Any]:
    """Return what is to be known of the times of set points, in ms.

    Args:
        rows: of one flight or of many.
        deadline_s: what counts as missed.
    """
    if not rows:
        return {}
    decided = [row for row in rows if row.decided]
    found: dict[str, Any] = {
        "set_points": len(rows),
        "decisions": len(decided),
        "deadlines_missed": sum(row.answered_s > deadline_s for row in rows),
    }
    for name, values in (
        ("answer_ms", [row.answered_s for row in rows]),
        ("decision_ms", [row.answered_s for row in decided]),
        ("state_age_ms", [row.state_age_s for row in rows]),
        ("image_age_ms", [row.image_age_s for row in decided]),
    ):
        each = 1e3 * np.array(values)
        found[name] = {
            "median": float(np.median(each)),
            "p99": float(np.quantile(each, 0.99)),
            "max": float(each.max()),
        }
    return found


def log_of(companion: Companion, about: dict[str, Any]) -> FlightLog | None:
    """Return a flight as the companion saw it, None where it had under two states."""
    rows = companion.rows
    if len(rows) < 2:
        return None
    first = rows[0].state.time_s
    flight = Flight(
        time_s=np.array([row.state.time_s - first for row in rows]),
        pos_w=np.stack([row.state.pos_w for row in rows]),
        quat_wxyz=np.stack([row.state.quat_wxyz for row in rows]),
        vel_w=np.stack([row.state.vel_w for row in rows]),
        rate_b=np.stack([row.state.rate_b for row in rows]),
        thrust_cmd=np.array([row.thrust for row in rows]),
        rate_cmd_b=np.stack([row.rate_b for row in rows]),
        rotor_speed=np.full((len(rows), 4), np.nan),
        action_b=np.stack([row.action_b for row in rows]),
        policy_step=np.array([row.decided for row in rows]),
        gate=np.array([row.gate for row in rows], np.int32),
        depth_m=None,
        about={**about, "events": companion.events, "handed_over": companion.over},
    )
    return log_from_flight(flight)
