"""Handle Ctrl-C and SIGTERM: a command ends within seconds with code 130, whatever it computes.

Python handles a signal between two of its own instructions, but XLA (the compiler of JAX) may work
for half a minute within one instruction. An interpreter that exits while the threads of XLA work
crashes, since it frees their memory. So a second thread waits for signals. If the main thread does
not handle a signal in time, the second thread ends the process at once. This is as safe as kill -9:
files are written completely or not at all, folder locks belong to the system, and the next command
removes partial files.

An exception in a destructor or in a callback of the garbage collector is lost: Python only reports
it. An interrupt that is lost in this way is sent again. So is one after which the command still
works `LOST_S` later, as a library may swallow any exception.
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

RESEND_S = 0.05
"""Time between the loss of an interrupt and its repetition [s]."""
PATIENCE_S = 3.0
"""Time that the main thread has to handle a signal [s]."""
LOST_S = 10.0
"""Time that a command has to end after an interrupt that the main thread handled [s]."""
MESSAGE = (
    "suite: interrupted in a step that cannot be stopped (mostly the compiler), so ended at once; "
    "what was saved is kept\n"
)
"""Message of a process that the second thread ends."""
_SHOW_CURSOR = "\x1b[?25h"
"""Terminal code that shows the cursor, which a progress bar hides."""


@contextmanager
def ends_in_seconds() -> Iterator[None]:
    """Turn SIGINT and SIGTERM into a KeyboardInterrupt, or end the process if none is raised.

    Outside of the main thread, and for ignored signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handled, finished = threading.Event(), threading.Event()
    old_hook = sys.unraisablehook

    def interrupt(signum: int, frame: FrameType | None) -> None:
        handled.set()
        raise KeyboardInterrupt

    def resend() -> None:
        if not finished.is_set():
            os.kill(os.getpid(), signals[-1])

    def resend_lost_interrupt(args: sys.UnraisableHookArgs) -> None:
        """Send an interrupt again that Python lost; report other lost errors as before."""
        if not issubclass(args.exc_type, KeyboardInterrupt):
            old_hook(args)
            return
        timer = threading.Timer(RESEND_S, resend)
        timer.daemon = True
        timer.start()

    signals = [s for s in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(s) != signal.SIG_IGN]
    # Python writes the number of every signal into a pipe (the wakeup file), which the second
    # thread reads.
    source, sink = os.pipe()
    os.set_blocking(sink, False)
    listener = threading.Thread(
        target=_listen, args=(source, signals, handled, finished), daemon=True
    )
    old_handlers = {number: signal.signal(number, interrupt) for number in signals}
    old_fd = signal.set_wakeup_fd(sink, warn_on_full_buffer=False)
    sys.unraisablehook = resend_lost_interrupt
    listener.start()
    try:
        yield
    finally:
        finished.set()
        sys.unraisablehook = old_hook
        signal.set_wakeup_fd(old_fd)
        for number, handler in old_handlers.items():
            signal.signal(number, handler)
        # The second thread ends when the pipe is closed and it waits for no signal.
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


def _listen(
    source: int,
    signals: list[signal.Signals],
    handled: threading.Event,
    finished: threading.Event,
) -> None:
    """Read the numbers of signals until the pipe closes; end the process at an unhandled one.

    If the command is not `finished` after a handled one, it is sent again.
    """
    while numbers := os.read(source, 1):
        if numbers[0] not in signals:
            continue
        if not handled.wait(PATIENCE_S):
            message = (_SHOW_CURSOR if os.isatty(2) else "") + MESSAGE
            os.write(2, message.encode())
            os._exit(INTERRUPTED)
        if not finished.wait(LOST_S):
            os.kill(os.getpid(), numbers[0])
