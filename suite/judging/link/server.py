"""Run a simulated vehicle in another process, which flies in real time at its end of the link."""

from __future__ import annotations

import multiprocessing
import signal
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

from eval.worlds.trial import TrialResult
from suite.common.errors import WorkFailed
from suite.judging.link.messages import Wire
from suite.judging.link.simulated import FlightRequest, SimulatedVehicle
from suite.judging.link.udp import UdpLink
from tracks.common.work.pickling import register_dict_views

VEHICLE, COMPANION = 1, 2
"""MAVLink system numbers of the two ends of the link."""
WAIT_S = 30.0
"""Longest time that the vehicle waits for the first set point [s]."""
LATE_S, SHIFT_S = 0.02, 0.05
"""Delays of a step: above the first it counts as a slip, and the following steps make up for it up
to the second; above that, later steps are shifted in time [s]."""


class VehicleResult(NamedTuple):
    """The vehicle's result of a flight."""

    trial: TrialResult
    slips: int
    """Number of delays above `LATE_S`, which a busy machine causes."""


class VehicleProcess:
    """The vehicle's process: `start` a flight, get its `result`, `stop` a running flight."""

    def __init__(self) -> None:
        """Start the process."""
        register_dict_views()
        context = multiprocessing.get_context("spawn")
        self._pipe, remote = context.Pipe()
        self._process = context.Process(target=serve, args=(remote,), daemon=True)
        self._process.start()
        remote.close()

    def start(self, request: FlightRequest) -> None:
        """Start a flight.

        Raises:
            WorkFailed: if the process has died.
        """
        self._exchange(lambda: self._pipe.send(request))

    def result(self, wait_s: float = 0.0) -> VehicleResult | None:
        """Wait for at most `wait_s` [s]; return the flight's result, or None while it runs.

        Raises:
            WorkFailed: if the process has died.
        """
        return self._exchange(lambda: self._pipe.recv() if self._pipe.poll(wait_s) else None)

    def stop(self) -> VehicleResult | None:
        """Stop the flight and return its result.

        Raises:
            WorkFailed: if the process has died.
        """
        self._exchange(lambda: self._pipe.send("stop"))
        return self.result(WAIT_S)

    def _exchange(self, transfer: Callable[[], Any]) -> Any:
        """Return what `transfer` returns, which uses the pipe."""
        try:
            return transfer()
        except (EOFError, OSError):
            raise WorkFailed("the simulated vehicle's process died; run again") from None

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._process.join(5.0)
        self._pipe.close()


def serve(pipe: Connection) -> None:
    """Fly all requests until the pipe closes; the main function of the vehicle's process."""
    # Ctrl-C reaches all processes of a terminal. This one ignores it: the companion ends it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    while True:
        try:
            request = pipe.recv()
        except EOFError:
            return
        if isinstance(request, FlightRequest):
            pipe.send(fly_in_real_time(request, pipe))


def fly_in_real_time(request: FlightRequest, pipe: Connection) -> VehicleResult:
    """Fly one trial in real time, until it ends or the pipe has a message (to stop)."""
    link = UdpLink(request.address)
    try:
        vehicle = SimulatedVehicle(request, Wire(VEHICLE, COMPANION))
        begin, due, slips, is_late = time.monotonic(), time.monotonic(), 0, False
        while not vehicle.over and not pipe.poll():
            # Wait until the step is due; if it is too late, shift the later steps.
            due += vehicle.dt
            now = time.monotonic()
            was_late, is_late = is_late, now - due > LATE_S
            slips += is_late and not was_late
            if now < due:
                time.sleep(due - now)
            elif now - due > SHIFT_S:
                due, is_late = now, False
            if not vehicle.begun and now - begin > WAIT_S:
                break
            link.send(vehicle.step(link.receive(), clock_s=due))
        # A handover during a delay ends the loop before the delay is counted.
        slips += not (vehicle.over or is_late) and time.monotonic() - due > LATE_S + vehicle.dt
    finally:
        link.close()
    return VehicleResult(vehicle.result(), slips)
