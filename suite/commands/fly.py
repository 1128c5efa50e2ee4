"""The command `suite fly`: fly a policy in real time over MAVLink, as on a companion computer."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from suite.common.console import Console
from suite.common.options import Advanced, Command
from suite.judging.link.watchdog import Limits
from suite.judging.requests import Evaluation, Flights
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Config(Command):
    """Fly a policy in real time over MAVLink; without --link against a simulated vehicle."""

    policy: str = ""
    """A shipped policy's name, a checkpoint's folder, or a policy file. Without it the policy race
    flies."""
    flown: Flights = Flights(track="zigzag", difficulty="0", trials=1)
    """The flights: tracks and vehicle."""
    speed: Annotated[float, Range(0.0, 1.0)] | None = None
    """For a policy with a speed input: 0 (careful) to 1 (a race). Without it the policy's own."""
    monitor: bool = False
    """Fly with the safety monitor of `suite eval --monitor`, which limits the policy's actions."""
    link: str = ""
    """udpin:HOST:PORT or udpout:HOST:PORT of a vehicle with MAVLink, for one flight. Without it a
    vehicle is simulated in real time on this machine."""
    signing_key: Path | None = None
    """With --link: file with a passphrase; messages are signed (MAVLink 2), and unsigned ones from
    the vehicle are ignored. Without it whoever reaches the link can steer the vehicle."""
    confirm: bool = False
    """Required with --link: you have done the checks of docs/fly.md. Set points are sent."""
    limits: Advanced[Limits] = Limits()
    """Beyond any of these the policy hands over to the autopilot."""
    out: Path = Path("runs/fly")
    """Folder for the flight logs and fly.json."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Fly, and write the flight logs.

    Raises:
        WorkFailed: if no vehicle answers.
    """
    from suite.judging.link.fly import fly_over_link
    from suite.judging.link.messages import signing_key

    speed = () if config.speed is None else (config.speed,)
    evaluation = Evaluation(**vars(config.flown), speed=speed, monitor=config.monitor)
    if config.link and not config.confirm:
        raise ValueError(
            f"--link {config.link}: set points would move a vehicle; read docs/fly.md, do its "
            "checks, then add --confirm"
        )
    defaults = type(config).flown
    if config.link and (
        config.flown.vehicle == defaults.vehicle or config.flown.track == defaults.track
    ):
        raise ValueError(
            f"--link {config.link}: give the vehicle file (--vehicle) and the course (--track) of "
            "this vehicle; the defaults, reference and zigzag, are for simulated vehicles"
        )
    if config.link and config.flown.time_limit_s != Flights().time_limit_s:
        raise ValueError(
            "--time-limit-s ends simulated flights only; leave it out with --link: a real flight "
            "ends at the last gate, at a limit of docs/fly.md, or with Ctrl-C"
        )
    if config.confirm and not config.link:
        raise ValueError(
            "--confirm needs --link, the vehicle's address; leave it out to simulate a vehicle"
        )
    if config.signing_key and not config.link:
        raise ValueError("--signing-key needs --link: only a real link is signed")
    return fly_over_link(
        evaluation, config.policy, config.link, config.limits, config.out, console,
        signing_key(config.signing_key),
    )  # fmt: skip
