"""Read and write the curve of a training run: a file with a row (JSON object) per gradient step.

A resumed run removes the rows after the checkpoint from which it continues.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from tracks.common.files import naming, to_json, write_text

CURVE = "metrics.jsonl"
"""File with a row per gradient step."""
WATCHED = "validation.jsonl"
"""File with a row per measurement of the policy during the training. In it `iteration` is the
number of gradient steps before the measurement."""


class Metric(NamedTuple):
    """How tables and charts show a measure of a training, such as the passed gates."""

    title: str
    """Name of the measure with its unit."""
    scale: float
    """Factor from the stored to the shown number."""
    digits: int
    """Number of decimal places in tables."""

    @property
    def heading(self) -> str:
        """The title above a chart."""
        return self.title if self.title.startswith("v_max") else self.title.capitalize()


METRICS = {
    "reward": Metric("reward", 1, 0),
    "success_cross": Metric("success cross [%]", 100, 0),
    "collision_free": Metric("collision-free rate [%]", 100, 0),
    "v_max": Metric("v_max [m/s]", 1, 1),
    "gates": Metric("gates", 1, 2),
    "collided": Metric("collided [%]", 100, 0),
    "speed": Metric("mean speed [m/s]", 1, 1),
}
"""Key in the rows of the curve and of the measurements -> how the measure is shown."""

Mirror = Callable[[list[dict[str, Any]]], None]
"""Function that receives the rows of the curve when they are written, for another program."""


def append(folder: Path, rows: list[dict[str, Any]], name: str = CURVE) -> None:
    """Add rows to the curve called `name` in `folder`."""
    with naming(folder / name), (folder / name).open("a", encoding="utf-8") as file:
        file.writelines(to_json(row) + "\n" for row in rows)


def read(folder: Path, name: str = CURVE) -> list[dict[str, Any]]:
    """Return the complete rows of the curve, each iteration once.

    A truncated last line and rows that an interrupted save wrote twice are left out.

    Raises:
        ValueError: if another line is damaged.
    """
    path = folder / name
    if not path.exists():
        return []
    # Bytes that are no text make their line invalid.
    rows, lines = [], path.read_text(encoding="utf-8", errors="replace").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            row = json.loads(line)
            iteration = row["iteration"]
        except (ValueError, KeyError, TypeError):
            if number == len(lines):
                break
            raise ValueError(
                f"{path}: line {number} is damaged; restore the file, or move it away: an "
                "unfinished training continues without its earlier curve"
            ) from None
        if not rows or iteration > rows[-1]["iteration"]:
            rows.append(row)
    return rows


def cut(folder: Path, iteration: int, name: str = CURVE) -> None:
    """Remove the rows from `iteration` on; the run computes them again."""
    if not (folder / name).exists():
        return
    rows = [row for row in read(folder, name) if row["iteration"] < iteration]
    write_text(folder / name, "".join(to_json(row) + "\n" for row in rows))


def tensorboard(folder: Path) -> Mirror:
    """Return a function that writes rows of a curve for TensorBoard, into `folder`/tensorboard.

    A resumed run continues; steps that it computes again replace the earlier ones.

    Raises:
        ValueError: if the optional package is missing.
    """
    try:
        package = importlib.import_module("tensorboardX")
    except ImportError:
        raise ValueError(
            "--tensorboard needs the package tensorboardX: pip install "
            "'diffracing-suite[tensorboard]', or leave --tensorboard out"
        ) from None
    # Empty until the first row, whose step says from where on earlier rows are replaced.
    writers: list[Any] = []

    def mirror(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            step = int(row["iteration"])
            if not writers:
                writers.append(package.SummaryWriter(str(folder / "tensorboard"), purge_step=step))
            for name, value in row.items():
                if name != "iteration" and isinstance(value, int | float):
                    writers[0].add_scalar(name, value, step)
        for writer in writers:
            writer.flush()

    return mirror
