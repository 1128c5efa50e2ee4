"""What stages of a loop do: take a policy, judge it, record its flights."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path

from rich.console import RenderableType

from eval.judging.results import read_trials
from suite.common.console import Console
from suite.common.estimate import Estimate
from suite.common.stages import Stages
from suite.judging.collect import Collection, collect
from suite.judging.evaluate import Judgement, evaluate
from suite.judging.flying import (
    PROCESS_BYTES,
    SECONDS_A_TRIAL,
    START_SECONDS,
    checkpoint_folder,
    options_for,
)
from tracks.common.files import replacing_folder


class Quiet(Console):
    """Keeps progress and leaves the lines of a stage's own result out: the loop has its own."""

    def say(self, text: str = "") -> None:
        """Print nothing."""

    def show(self, table: RenderableType) -> None:
        """Print nothing."""


def take_policy(stages: Stages, given: str) -> Path:
    """Copy a shipped policy or a checkpoint into the loop's folder and return the copy."""

    def copy(folder: Path) -> None:
        with replacing_folder(folder / "policy") as beside:
            shutil.copytree(checkpoint_folder(given), beside, dirs_exist_ok=True)

    return stages.do("given", f"taking {given} instead of training", copy) / "policy"


def judge(stages: Stages, name: str, words: str, judgement: Judgement) -> Path:
    """Judge a policy in the folder `name`, say how it went, and return the folder."""
    folder = stages.do(name, words, lambda out: evaluate(judgement, out, Quiet()))
    rows = read_trials(folder / "trials.parquet")
    won = sum(row.success for row in rows) / len(rows)
    gates = sum(row.gates_passed for row in rows) / len(rows)
    stages.console.note(
        f"    {won:.0%} of {len(rows)} trials succeed, {gates:.1f} gates on average"
    )
    return folder


def record(stages: Stages, collection: Collection) -> Path:
    """Record flights in the folder `flights` and return it."""
    words = "recording flights on other seeds"
    return stages.do("flights", words, lambda out: collect(collection, out, Quiet()))


def flying(trials: int) -> Estimate:
    """Return about how long `trials` take in MuJoCo, and their memory."""
    processes = options_for(trials, None, "mujoco").processes or 1
    seconds = START_SECONDS + trials * SECONDS_A_TRIAL / processes
    return Estimate(seconds, processes * PROCESS_BYTES)


def what_is_left(stages: Stages, needs: Mapping[str, Estimate]) -> Estimate:
    """Return the time of the stages in `needs` that are not done, and the largest memory."""
    left = [need for name, need in needs.items() if not stages.is_done(name)]
    most = max((need.memory_bytes for need in left), default=0.0)
    return Estimate(sum(need.seconds for need in left), most)
