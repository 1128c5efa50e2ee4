"""Fly over the link in real time: many trials with a simulated vehicle, or one with a real vehicle.

The companion (`companion.py`) runs the policy and its checks. This module exchanges its datagrams
with the vehicle, and computes statistics of its delays.
"""

from __future__ import annotations

import contextlib
import gc
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.worlds.mujoco import MujocoWorld
from eval.worlds.trial import Rules, TrialSpec, track_of
from policies.observation import Observation
from policies.policy import Policy
from suite.common.console import Console
from suite.judging.link.companion import FINISHED, Companion, Row
from suite.judging.link.log import write_log
from suite.judging.link.messages import Wire
from suite.judging.link.server import COMPANION, VEHICLE, WAIT_S, VehicleProcess
from suite.judging.link.simulated import FlightRequest
from suite.judging.link.udp import UdpLink
from suite.judging.link.watchdog import Limits
from suite.judging.trials import TrialSet

HEARTBEAT_S = 1.0
"""Time between heartbeats of the companion [s]."""
POLL_S = 0.002
"""Longest wait for messages, after which the watchdog checks the times [s]."""
AFTER_S = 0.5
"""Time that the vehicle's process has to report the end of a trial after the last gate [s]."""


class Flight(NamedTuple):
    """One flight over the link."""

    row: dict[str, Any]
    """Result of the flight, a row of fly.json."""
    rows: list[Row]
    """States and set points of the flight."""


def warm_up(policy: Policy) -> None:
    """Run a policy a few times before a flight, so that nothing is compiled in flight."""
    spec = policy.spec
    shapes = (1, spec.state_size), (1, *spec.image_shape)
    observation = Observation(*(np.zeros(shape, np.float32) for shape in shapes))
    hidden = policy.start(1)
    for _ in range(3):
        _, hidden = policy.act(hidden, *observation, np.ones(1, bool))


def fly_simulated(
    policy: Policy, trial_set: TrialSet, rules: Rules, limits: Limits, out: Path, console: Console
) -> Iterator[Flight]:
    """Fly all trials in real time with a simulated vehicle on this machine; yield the flights."""
    warm_up(policy)
    vehicle, successes = VehicleProcess(), 0
    try:
        with console.progress("flights", len(trial_set.trials)) as update:
            for number, trial in enumerate(trial_set.trials, 1):
                flight = _fly_trial(policy, trial, trial_set, rules, limits, out, vehicle, console)
                yield flight
                successes += flight.row["success"]
                update(number, f"{successes} of {number} finished")
    finally:
        vehicle.close()


def _fly_trial(
    policy: Policy,
    trial: TrialSpec,
    trial_set: TrialSet,
    rules: Rules,
    limits: Limits,
    out: Path,
    vehicle: VehicleProcess,
    console: Console,
) -> Flight:
    """Fly one trial with the vehicle's process, and write the companion's log into `out`."""
    # Open both ends of the link.
    wire, track = Wire(COMPANION, VEHICLE), track_of(trial_set.tracks, trial)
    link = UdpLink("udpin:127.0.0.1:0", wire.is_from_peer)
    try:
        companion = Companion(policy, track, trial_set.vehicle, wire, time.monotonic, limits)
        address = f"udpout:127.0.0.1:{link.port}"
        camera, rate_hz = policy.spec.camera, policy.spec.rate_hz
        vehicle.start(
            FlightRequest(
                track, trial, trial_set.vehicle, rules, camera, rate_hz, policy.name, address
            )
        )
        # Fly until the trial ends or the companion hands over.
        result = None
        with _no_garbage_collection():
            while result is None and companion.over is None:
                link.send(companion.receive(link.receive(POLL_S)))
                result = vehicle.result()
        if result is None:
            wait_s = AFTER_S if companion.over == FINISHED else 0.0
            result = vehicle.result(wait_s) or vehicle.stop()
    finally:
        link.close()
    assert result is not None
    trial_row = {**result.trial._asdict(), **companion.outputs.columns(0)}
    step_s = 1.0 / trial_set.vehicle.controller.frequency
    about = {**trial_row, "integrator": MujocoWorld.integrator, "step_s": step_s}
    row = {
        **trial_row,
        "handed_over": None if companion.over == FINISHED else companion.over,
        "vehicle_slips": result.slips,
        "missed_decisions": companion.missed_decisions,
        "repeated_images": companion.repeated_images,
        "file": write_log(companion, about, out, console),
    }
    return Flight(row, companion.rows)


def fly_link(
    companion: Companion,
    link: UdpLink,
    clock: Callable[[], float] = time.monotonic,
    wait_s: float = WAIT_S,
) -> None:
    """Fly a vehicle at the other end of `link` until the companion hands over.

    It also ends if no vehicle answers within `wait_s` [s]. After an interrupt (Ctrl-C) no set point
    is sent.
    """
    begin_s, heartbeat_s = clock(), -math.inf
    with _no_garbage_collection():
        while companion.over is None:
            if clock() - heartbeat_s > HEARTBEAT_S:
                link.send([companion.heartbeat()])
                heartbeat_s = clock()
            link.send(companion.receive(link.receive(POLL_S)))
            if not companion.rows and clock() - begin_s > wait_s:
                return


def totals(flights: list[Flight], limits: Limits) -> dict[str, Any]:
    """Return the sums over all flights, and statistics of their delays, for fly.json."""
    rows = [row for flight in flights for row in flight.rows]
    return {
        "trials": len(flights),
        "successes": sum(bool(flight.row["success"]) for flight in flights),
        "handed_over": sum(flight.row["handed_over"] is not None for flight in flights),
        "vehicle_slips": sum(flight.row["vehicle_slips"] for flight in flights),
        "late_answers": sum(flight.row["late_actions"] for flight in flights),
        "missed_decisions": sum(flight.row["missed_decisions"] for flight in flights),
        "repeated_images": sum(flight.row["repeated_images"] for flight in flights),
        **delays(rows, limits.deadline_s),
    }


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Disable Python's garbage collector, which would stop the companion for milliseconds."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def delays(rows: list[Row], deadline_s: float) -> dict[str, Any]:
    """Return statistics of the delays of set points [ms].

    An answer that takes longer than `deadline_s` [s] counts as missed.
    """
    if not rows:
        return {}
    decided = [row for row in rows if row.decided]
    statistics: dict[str, Any] = {
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
        delay_ms = 1e3 * np.array(values)
        statistics[name] = {
            "median": float(np.median(delay_ms)),
            "p99": float(np.quantile(delay_ms, 0.99)),
            "max": float(delay_ms.max()),
        }
    return statistics
