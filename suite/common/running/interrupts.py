"""Ctrl-C and a polite kill: a command ends in seconds with 130, whatever it is in the middle of.

Python hears of a signal between two of its own instructions. XLA compiles for half a minute within
one, and an interpreter that ends while XLA's threads are at work crashes (it frees what they use).
So a second thread listens: where the main thread has not heard of the signal in time, the process
ends at once. That is as safe as kill -9: every file is written whole or not at all, the lock of a
folder is the system's, and what lies about half-written is swept by the next command.

What is raised within a destructor or a callback of the garbage collector goes nowhere:
Python reports it and goes on. An interrupt that was lost so is sent again.
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
"""Until an interrupt that was lost is sent again [s]."""
PATIENCE_S = 3.0
"""The main thread has this long to hear of a signal [s]."""
WORDS = (
    "suite: interrupted in a step that cannot be stopped (mostly the compiler), so ended at once; "
    "what was saved is kept\n"
)
_SHOW_CURSOR = "\x1b[?25h"


@contextmanager
def ends_in_seconds() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into a KeyboardInterrupt, or where none comes up, into an end.

    Outside of the main thread signals are someone else's business, as is one that is ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, left = threading.Event(), threading.Event()
    report = sys.unraisablehook

    def interrupt(signum: int, frame: FrameType | None) -> None:
        heard.set()
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
    listener = threading.Thread(target=_listen, args=(source, mine, heard), daemon=True)
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
        heard.set()
        listener.join()
        os.close(source)


def end_at_once(code: int) -> NoReturn:
    """End the process without taking the interpreter down, which crashes while XLA compiles."""
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _listen(source: int, mine: list[signal.Signals], heard: threading.Event) -> None:
    """Read the numbers of signals until the pipe is closed; end the process if none hears."""
    while numbers := os.read(source, 1):
        if numbers[0] in mine and not heard.wait(PATIENCE_S):
            words = (_SHOW_CURSOR if os.isatty(2) else "") + WORDS
            os.write(2, words.encode())
            os._exit(INTERRUPTED)
