"""The command `suite eval`: judge policies in a simulator, on tracks that no training uses."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from suite.common.console import Console
from suite.common.options import Advanced, Command
from suite.common.work import WorkersOption, read_workers_option
from suite.judging.requests import Evaluation
from tracks.common.files import check_place


@dataclass(frozen=True)
class Config(Command):
    """Fly trials and write tables of the results; further policies are compared with the first."""

    flown: Evaluation = Evaluation()
    """The flights: policies, tracks, vehicle and simulator."""
    out: Path = Path("runs/eval")
    """Folder for trials.parquet, table.md, summary.json and run.json."""
    rerun: Advanced[Path | None] = None
    """Also write this recording (.rrd, for rerun) of the first trial of every track and level."""
    workers: WorkersOption = None
    """Share the trials among N processes of this machine, or on the cluster at HOST:PORT, whose
    owner can run code here. Without it as many cores are used as shorten the work."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Judge the policies, write the tables, and a recording if there is --rerun.

    Raises:
        ValueError: for an option that cannot be used, before the first flight.
    """
    from suite.judging.evaluate import evaluate

    if config.rerun and config.rerun.suffix != ".rrd":
        raise ValueError(f"--rerun {config.rerun}: a recording's name must end in .rrd")
    if config.rerun:
        from eval.judging.judge import check_records

        check_records(config.flown.simulator)
        check_place(config.rerun)
    answer = evaluate(config.flown, config.out, console, read_workers_option(config.workers))
    if config.rerun:
        from eval.view.recording import write_recording
        from suite.judging.replay import first_trials, fly_again

        write_recording(config.rerun, *fly_again(config.flown, first_trials(config.flown)))
        console.say(f"written: {config.rerun} (open it with: rerun {config.rerun})")
        answer["rerun"] = str(config.rerun)
    return answer
