"""Ctrl-C and SIGTERM: a command ends within seconds with code 130, at any point of its work.

Python handles a signal between two of its own instructions, but XLA may compile for half a minute
within one. An interpreter that exits while XLA's threads work crashes, since it frees their memory.
So a second thread waits for signals: if the main thread does not handle one in time, the process
ends at once. This is as safe as kill -9: files are written completely or not at all, folder locks
belong to the system, and the next command removes partial files.

An exception in a destructor or a callback of the garbage collector is lost: Python only reports it.
An interrupt that is lost in this way is sent again.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

from suite.common.errors import INTERRUPTED

AGAIN_S = 0.05
"""Time before a lost interrupt is sent again [s]."""
PATIENCE_S = 3.0
"""Time for the main thread to handle a signal [s]."""
WORDS = (
    "suite: interrupted in a step that cannot be stopped (mostly the compiler), so ended at once; "
    "what was saved is kept\n"
)
_SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def ends_in_seconds() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into a KeyboardInterrupt, or end the process if none is raised.

    Outside of the main thread, and for ignored signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handled, left = threading.Event(), threading.Event()
    report = sys.unraisablehook

    def interrupt(signum: int, frame: FrameType | None) -> None:
        handled.set()
        raise KeyboardInterrupt

    def again() -> None:
        if not left.is_set():
            os.kill(os.getpid(), mine[-1])

    def lost(what: sys.UnraisableHookArgs) -> None:
        if not issubclass(what.exc_type, KeyboardInterrupt):
            report(what)
            return
        timer = threading.Timer(AGAIN_S, again)
        timer.daemon = True
        timer.start()

    mine = [s for s in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(s) != signal.SIG_IGN]
    source, sink = os.pipe()
    os.set_blocking(sink, False)
    listener = threading.Thread(target=_listen, args=(source, mine, handled), daemon=True)
    before = {number: signal.signal(number, interrupt) for number in mine}
    fd_before = signal.set_wakeup_fd(sink, warn_on_full_buffer=False)
    sys.unraisablehook = lost
    listener.start()
    try:
        yield
    finally:
        left.set()
        sys.unraisablehook = report
        signal.set_wakeup_fd(fd_before)
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(sink)
        handled.set()
        listener.join()
        os.close(source)


def end_at_once(code: int) -> NoReturn:
    """End the process without the interpreter's shutdown, which crashes while XLA compiles."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _listen(source: int, mine: list[signal.Signals], handled: threading.Event) -> None:
    """Read the numbers of signals until the pipe closes; end the process at an unhandled one."""
    while numbers := os.read(source, 1):
        if numbers[0] in mine and not handled.wait(PATIENCE_S):
            words = (_SHOW_CURSOR if os.isatty(2) else "") + WORDS
            os.write(2, words.encode())
            os._exit(INTERRUPTED)
