"""The text output of a command: results on standard output, progress on standard error."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING

from tracks.common.names import printable

if TYPE_CHECKING:
    from rich.console import Console as RichConsole
    from rich.console import ConsoleOptions
    from rich.segment import Segment
    from rich.table import Table

PLAIN_PERIOD_S = 10.0
"""Time between two lines about the progress if standard error is no terminal [s]."""


Update = Callable[..., None]
"""Function (done, note) that shows that `done` of the total is finished, with a short note (or
none)."""


class Console:
    """The text output of one command."""

    def say(self, text: str = "") -> None:
        """Print a line of the command's result (on standard error under --json)."""
        print(printable(text), flush=True)

    def show(self, table: Table) -> None:
        """Print a rich table; its width is not limited if standard output is no terminal."""
        from rich.console import Console as RichConsole

        width = None if sys.stdout.isatty() else 200
        console = RichConsole(file=sys.stdout, width=width)
        _fit(table, console)
        console.print(_Printable(table))

    def note(self, text: str) -> None:
        """Print a line about the progress, or a warning, on standard error."""
        print(printable(text), file=sys.stderr, flush=True)

    @contextmanager
    def progress(self, label: str, total: float, begun: float = 0.0) -> Iterator[Update]:
        """Show the progress of a long piece of work; yields the function that reports it.

        The reported `done` is `total` at the end, in any unit, and `begun` at the beginning. What
        was done before, such as by an earlier call, does not count for the estimate of the
        remaining time.
        """
        if sys.stderr.isatty():
            with _bar(label, total, begun) as update:
                yield update
            return
        last = time.monotonic()
        first: tuple[float, float] | None = None

        def update(done: float, note: str = "") -> None:
            """Print a line, unless the last one was printed a short time ago."""
            nonlocal last, first
            now = time.monotonic()
            # The first part also loads and compiles, so its rate does not count.
            first = first or (now, done)
            if now - last < PLAIN_PERIOD_S:
                return
            last = now
            seconds, newly_done = now - first[0], done - first[1]
            left = ""
            if newly_done:
                left = f", {duration(seconds * (total - done) / newly_done)} left"
            self.note(f"{label}: {done:g} of {total:g}{left}{note and ', ' + note}")

        yield update


def _fit(table: Table, console: RichConsole) -> None:
    """Set the widths of a table's columns so that a narrow terminal cuts no text.

    Lines break between words. If even the longest words do not fit, they break too.
    """
    from rich.measure import Measurement

    texts = [(column.header, *column.cells) for column in table.columns]
    sizes = [[Measurement.get(console, console.options, text) for text in cells] for cells in texts]
    words = [max(size.minimum for size in column) for column in sizes]
    # A column has a border and, if there is room, a space on either side.
    padding = int(sum(words) + 3 * len(words) < console.width)
    table.padding = (0, padding)
    spare = console.width - 1 - sum(words) - (1 + 2 * padding) * len(words)
    for column, word, column_sizes in zip(table.columns, words, sizes, strict=True):
        more = min(max(spare, 0), max(size.maximum for size in column_sizes) - word)
        column.width, column.overflow = word + more, "fold"
        spare -= more


class _Printable:
    """A table without unprintable characters; rich's own control codes are kept."""

    def __init__(self, table: Table) -> None:
        self._table = table

    def __rich_console__(self, console: RichConsole, options: ConsoleOptions) -> Iterator[Segment]:
        for part in console.render(self._table, options):
            yield part if part.control else part._replace(text=printable(part.text))


class Quiet(Console):
    """A console that prints progress only: the caller prints the results itself."""

    def say(self, text: str = "") -> None:
        """Print nothing."""

    def show(self, table: Table) -> None:
        """Print nothing."""


class Silent(Quiet):
    """A console that prints nothing. In another process it forwards the progress."""

    def __init__(self, forward: Callable[[float, float], None] = lambda done, total: None) -> None:
        """Make a console that calls `forward` with what is done of a total."""
        self._forward = forward

    def note(self, text: str) -> None:
        """Print nothing."""

    @contextmanager
    def progress(self, label: str, total: float, begun: float = 0.0) -> Iterator[Update]:
        """Forward the progress of a long piece of work."""
        yield lambda done, note="": self._forward(done, total)


@contextmanager
def _bar(label: str, total: float, begun: float) -> Iterator[Update]:
    """Show a progress bar on a terminal; yields the function that updates it."""
    from rich.console import Console as RichConsole
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.completed:g}/{task.total:g}"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=RichConsole(stderr=True), transient=True) as bars:
        task = bars.add_task(printable(label), total=total, note="")
        bars.update(task, completed=begun)

        def update(done: float, note: str = "") -> None:
            bars.update(task, completed=done, note=printable(note))

        yield update


@contextmanager
def stdout_kept_clean() -> Iterator[None]:
    """Send all output to standard error while the context lasts, also that of native libraries.

    With --json standard output has nothing but the JSON object.
    """
    sys.stdout.flush()
    stdout_copy = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout_copy, 1)
        os.close(stdout_copy)


def command_line(*words: object) -> str:
    """Return a command to copy into a shell: a path with spaces is quoted."""
    return shlex.join(map(str, words))


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as "1 flight" or "2 flights"."""
    return f"{count} {noun if count == 1 else noun + 's'}"


def duration(seconds: float) -> str:
    """Return `seconds` as text: "0.4 s", "12 s", "3 min 20 s", "2 h 05 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    seconds_rounded = round(seconds)
    if seconds_rounded < 60:
        return f"{seconds_rounded} s"
    if seconds_rounded < 3600:
        return f"{seconds_rounded // 60} min {seconds_rounded % 60:02d} s"
    return f"{seconds_rounded // 3600} h {seconds_rounded % 3600 // 60:02d} min"


def size(count: float) -> str:
    """Return a number of bytes as text: "812 kB", "2.1 GB"."""
    for unit in ("B", "kB", "MB"):
        if count < 999.5:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
