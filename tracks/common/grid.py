"""Tables of text cells, and their output as Markdown, as HTML and in a terminal (rich)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, NamedTuple, TypeVar

from tracks.common.names import printable

if TYPE_CHECKING:
    from rich.table import Table


Row = TypeVar("Row")
_TAG = re.compile(r"<(?=[A-Za-z/!?])")
"""The bracket that opens an HTML tag, comment or declaration."""


class Cell(NamedTuple):
    """One cell of a table."""

    text: str
    tone: str = ""
    """`good` or `bad` colours the cell; empty for neither."""


@dataclass(frozen=True)
class Grid:
    """A table of text, before it is written in any format."""

    title: str
    """Text above the table."""
    headers: Sequence[str]
    """One text for each column."""
    rows: Sequence[Sequence[Cell]]
    """Rows of the table, each with as many cells as there are headers."""
    strong_last: bool = False
    """Whether the last row is a sum, printed in bold."""
    note: str = ""
    """Text below the table."""


def table(
    headers: Sequence[str],
    lines: Iterable[Sequence[str | Cell]],
    title: str = "",
    note: str = "",
    strong_last: bool = False,
) -> Grid:
    """Return a table of texts and of cells with a tone."""
    rows = [[Cell(entry) if isinstance(entry, str) else entry for entry in row] for row in lines]
    return Grid(title, headers, rows, strong_last, note)


def table_of(
    rows: Iterable[Row],
    *columns: tuple[str, Callable[[Row], str | Cell]],
    title: str = "",
    note: str = "",
) -> Grid:
    """Return a table with a line for each of `rows`.

    A column is a header and a function of a row that returns the cell. Title and note are above and
    below the table.
    """
    lines = [[cell_of(row) for _, cell_of in columns] for row in rows]
    return table([header for header, _ in columns], lines, title, note)


def markdown(grid: Grid) -> str:
    """Return a table as Markdown."""
    rows = [[cell.text for cell in row] for row in grid.rows]
    lines = [list(grid.headers), ["---"] * len(grid.headers), *rows]
    text = "\n".join("| " + " | ".join(map(markdown_cell, row)) + " |" for row in lines)
    return "\n\n".join(part for part in (grid.title, text, grid.note) if part) + "\n"


def markdown_cell(text: str) -> str:
    """Return a text from an untrusted source as a Markdown cell, without HTML tags.

    Control characters, opening brackets of tags and column separators are escaped.
    """
    return _TAG.sub("&lt;", printable(text, keep="")).replace("|", "\\|")


def rich_table(grid: Grid) -> Table:
    """Return a table for a terminal."""
    from rich.markup import escape as literal
    from rich.table import Table

    tones = {"good": "green", "bad": "red", "": ""}
    table = Table(
        *map(literal, grid.headers),
        title=literal(grid.title),
        title_justify="left",
        caption=literal(grid.note) or None,
        caption_justify="left",
    )
    for number, row in enumerate(grid.rows):
        is_sum = grid.strong_last and number == len(grid.rows) - 1
        if is_sum:
            table.add_section()
        cells = [
            f"[{tone}]{literal(cell.text)}[/]" if (tone := tones[cell.tone]) else literal(cell.text)
            for cell in row
        ]
        table.add_row(*cells, style="bold" if is_sum else None)
    return table


def html_table(grid: Grid) -> str:
    """Return a table as HTML; classes for the style sheet are `sum`, `good` and `bad`."""
    head = "".join(f'<th scope="col">{escape(header)}</th>' for header in grid.headers)
    rows = []
    for number, row in enumerate(grid.rows):
        strong = grid.strong_last and number == len(grid.rows) - 1
        cells = "".join(
            f'<td class="{cell.tone}">{escape(cell.text)}</td>' if cell.tone
            else f"<td>{escape(cell.text)}</td>"
            for cell in row
        )  # fmt: skip
        rows.append(f'<tr class="sum">{cells}</tr>' if strong else f"<tr>{cells}</tr>")
    caption = f"<caption>{escape(grid.title)}</caption>" if grid.title else ""
    note = f'<p class="note">{escape(grid.note)}</p>' if grid.note else ""
    body = "\n".join(rows)
    table = f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>\n{body}\n</tbody></table>"
    return f'<div class="scroll">{table}</div>{note}'
