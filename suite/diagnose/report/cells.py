"""Rows of plain cells, which most tables of the report have."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tracks.common.grid import Cell, Grid


def cells(*texts: str) -> list[Cell]:
    """Return a row of cells without a tone."""
    return [Cell(text) for text in texts]


def grid(title: str, headers: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> Grid:
    """Return a table of plain texts."""
    return Grid(title, headers, [cells(*row) for row in rows], note=note)


def short_name(name: str) -> str:
    """Return a log's name without its folders."""
    return name.replace("\\", "/").rsplit("/", 1)[-1]
