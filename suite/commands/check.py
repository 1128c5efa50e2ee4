"""`suite check`: faults of an interface, before anything is concluded from flights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from suite.common.console import Console
from suite.common.options import Advanced, Command
from tracks.input.ranges import Range


@dataclass(frozen=True)
class Config(Command):
    """Check flights, a vehicle file and a policy for mistakes of unit, frame, sign and scale."""

    flights: tyro.conf.Positional[tuple[Path, ...]] = ()
    """Flight logs, or folders of them; `suite import` makes them of other programs' logs."""
    vehicle: str = ""
    """Compare the flights with this vehicle: a vehicle file or a shipped name. Without it the
    flights are checked alone."""
    policy: str = ""
    """Check this policy: a shipped name, a checkpoint's folder, or a file (.onnx, .pt2, .c)."""
    fix: bool = False
    """Write the flights into --out, with what is certain and unambiguous corrected."""
    out: Path = Path("checked")
    """Folder for the flights of --fix."""
    trials: Advanced[Annotated[int, Range(0, 1000)]] = 4
    """Short flights of --policy on easy tracks, which show the size of its actions."""
    trust: Advanced[bool] = False
    """Also load policy files that can run code on this machine (.pt2, .pt, .c)."""

    def written(self) -> list[Path]:
        """Return the folders into which no other command may write meanwhile."""
        return [self.out] if self.fix else []


def run(config: Config, console: Console) -> dict[str, Any]:
    """List what is assumed and what looks wrong.

    Raises:
        ValueError: where there is nothing to check, or something is refused.
    """
    from suite.judging.checking import check_flight_files, check_policy

    if not config.flights and not config.policy and not config.vehicle:
        raise ValueError("nothing to check: give flights, --vehicle or --policy")
    answer: dict[str, Any] = {"findings": [], "not_identifiable": []}
    policy = None
    if config.policy:
        policy, found = check_policy(config.policy, config.trust, config.trials, console)
        answer |= found
    if config.flights or config.vehicle:
        out = config.out if config.fix else None
        found = check_flight_files(config.flights, config.vehicle, policy, out, console)
        found["findings"] = [*answer["findings"], *found["findings"]]
        answer |= found
    if not any(finding["status"] in ("doubt", "corrected") for finding in answer["findings"]):
        console.say("nothing to report")
    return answer
