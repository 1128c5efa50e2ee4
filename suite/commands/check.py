"""The command `suite check`: find faults of an interface in logs, vehicle and policy files."""

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
    """Flight logs, or folders of them; `suite import` converts the logs of other programs."""
    vehicle: str = ""
    """Compare the flights with this vehicle: a vehicle file or a shipped name. Without it only the
    flights are checked."""
    policy: str = ""
    """Check this policy: a shipped name, a checkpoint's folder, or a file (.onnx, .pt2, .c)."""
    fix: bool = False
    """Write the flights into --out, with certain and unambiguous faults corrected."""
    out: Path = Path("checked")
    """Folder for the corrected flights of --fix."""
    trials: Advanced[Annotated[int, Range(0, 1000)]] = 4
    """Short flights of --policy on easy tracks, which show the size of its actions."""
    trust: Advanced[bool] = False
    """Also load policy files that can run code on this machine (.pt2, .pt, .c)."""

    def written(self) -> list[Path]:
        """Return the folders that this command writes; while it runs, no other may write there."""
        return [self.out] if self.fix else []


def run(config: Config, console: Console) -> dict[str, Any]:
    """List the assumptions about the interface, and probable faults.

    Returns:
        `findings`, `not_identifiable` (faults that these files can neither show nor exclude), and
        facts about the checked files.
    """
    from eval.logs.faults.check import NOT_CHECKED
    from suite.judging.checking import check_flight_files, check_policy

    if not config.flights and not config.policy and not config.vehicle:
        raise ValueError("nothing to check: give flights, --vehicle or --policy")
    if config.fix and not config.flights:
        raise ValueError("--fix corrects flights, and none is given: add them, or leave it out")
    if not config.policy:
        config.refuse_unused(("trials", "trust"), "no --policy is given")
    answer: dict[str, Any] = {"findings": [], "not_identifiable": []}
    policy = None
    if config.policy:
        policy, result = check_policy(config.policy, config.trust, config.trials, console)
        answer |= result
    if config.flights or config.vehicle:
        out = config.out if config.fix else None
        result = check_flight_files(config.flights, config.vehicle, policy, out, console)
        result["findings"] = [*answer["findings"], *result["findings"]]
        answer |= result
    if config.out != Config.out and not config.fix:
        console.note("--out is not used: nothing is written without --fix")
    if not any(
        finding["status"] in ("doubt", "corrected") or finding["signal"] == NOT_CHECKED
        for finding in answer["findings"]
    ):
        console.say("no fault found")
    return answer
