"""What a command says to a person: lines on standard output, progress on standard error."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from typing import TYPE_CHECKING, Protocol

from tracks.common.names import printable

if TYPE_CHECKING:
    from rich.console import Console as RichConsole
    from rich.console import ConsoleOptions, RenderableType
    from rich.segment import Segment

PLAIN_PERIOD_S = 10.0
"""Where standard error is no terminal, progress is a plain line this often [s]."""


class Update(Protocol):
    """The function to call as work goes on."""

    def __call__(self, done: float, note: str = "") -> None:
        """Show that `done` of the total is done, with a few words."""
        ...


class Console:
    """People's output of one command."""

    def say(self, text: str = "") -> None:
        """Print a line of the command's result (on standard error under --json)."""
        print(printable(text), flush=True)

    def show(self, table: RenderableType) -> None:
        """Print a rich table; as wide as it needs where standard output is no terminal."""
        from rich.console import Console as RichConsole

        wide = None if sys.stdout.isatty() else 200
        RichConsole(file=sys.stdout, width=wide).print(_Printable(table))

    def note(self, text: str) -> None:
        """Print a line about the work itself, on standard error."""
        print(printable(text), file=sys.stderr, flush=True)

    @contextmanager
    def progress(
        self,
        label: str,
        total: float,
        clock: Callable[[], float] = time.monotonic,
        begun: float = 0.0,
    ) -> Iterator[Update]:
        """Show how far a long piece of work is; yields the function to call as it goes.

        Args:
            label: what is being done, a few words.
            total: the `done` at which it is finished, in any unit.
            clock: seconds, increasing.
            begun: the `done` at which it starts: what was there before took no time here.
        """
        if sys.stderr.isatty():
            with _bar(label, total, begun) as update:
                yield update
            return
        started = last = clock()

        def update(done: float, note: str = "") -> None:
            nonlocal last
            now = clock()
            if now - last < PLAIN_PERIOD_S:
                return
            last = now
            new = done - begun
            left = duration((now - started) * (total - done) / new) if new else "unknown"
            self.note(f"{label}: {done:g} of {total:g}, {left} left{note and ', ' + note}")

        yield update


class _Printable:
    """A table whose texts are as they may be printed; rich's own control codes stay."""

    def __init__(self, table: RenderableType) -> None:
        self._table = table

    def __rich_console__(self, console: RichConsole, options: ConsoleOptions) -> Iterator[Segment]:
        for part in console.render(self._table, options):
            yield part if part.control else part._replace(text=printable(part.text))


class Quiet(Console):
    """Leaves the lines of a result out and keeps progress: who called has lines of its own."""

    def say(self, text: str = "") -> None:
        """Print nothing."""

    def show(self, table: RenderableType) -> None:
        """Print nothing."""


@contextmanager
def _bar(label: str, total: float, begun: float) -> Iterator[Update]:
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
    """Send all that is printed meanwhile to standard error, native libraries' lines included."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def duration(seconds: float) -> str:
    """Return `seconds` for people: "0.4 s", "12 s", "3 min 20 s", "2 h 05 min"."""
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"


def size(count: float) -> str:
    """Return a number of bytes for people: "812 kB", "2.1 GB"."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.1f} GB"
