"""The curve of a run: one JSON object a line, cut back to the checkpoint when a run resumes."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tracks.common.files import naming, to_json, write_text

CURVE = "metrics.jsonl"
"""A row a gradient step."""
WATCHED = "validation.jsonl"
"""A row each time that the policy was measured; `iteration` is of the gradient steps done."""


Mirror = Callable[[list[dict[str, Any]]], None]
"""Takes rows of the curve as they are written, to show them elsewhere."""


def append(folder: Path, rows: list[dict[str, Any]], name: str = CURVE) -> None:
    """Add rows to the curve called `name` in `folder`."""
    with naming(folder / name), (folder / name).open("a", encoding="utf-8") as file:
        file.writelines(to_json(row) + "\n" for row in rows)


def read(folder: Path, name: str = CURVE) -> list[dict[str, Any]]:
    """Return the whole rows of the curve, each iteration once.

    A last line cut short by a kill is left out, as are rows that an interrupted save wrote twice.
    """
    path = folder / name
    if not path.exists():
        return []
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            break
        if not rows or row["iteration"] > rows[-1]["iteration"]:
            rows.append(row)
    return rows


def cut(folder: Path, iteration: int, name: str = CURVE) -> None:
    """Drop the rows from `iteration` on: they are computed again."""
    if not (folder / name).exists():
        return
    kept = [row for row in read(folder, name) if row["iteration"] < iteration]
    write_text(folder / name, "".join(to_json(row) + "\n" for row in kept))


def tensorboard(folder: Path) -> Mirror:
    """Return what writes rows of a curve for TensorBoard, into `folder`/tensorboard.

    A resumed run writes on; steps that it computes again replace those of before.

    Raises:
        ValueError: where the optional package is missing.
    """
    try:
        package = importlib.import_module("tensorboardX")
    except ImportError:
        raise ValueError(
            "--tensorboard needs the package tensorboardX: pip install "
            "'diffracing-suite[tensorboard]', or leave --tensorboard out"
        ) from None
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
