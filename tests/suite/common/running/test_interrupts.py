"""A signal ends a command with 130 in seconds, also in the middle of what Python cannot stop."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time

import pytest

from suite.common.running import interrupts
from suite.common.running.interrupts import ends_in_seconds

IN_C = """
    import ctypes, os, signal, threading
    from suite.common.running import interrupts

    # A shell that starts the tests in the background has them ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    interrupts.PATIENCE_S = 0.3
    lock, mutex = ctypes.CDLL(None).pthread_mutex_lock, ctypes.create_string_buffer(64)
    lock(mutex)
    with interrupts.ends_in_seconds():
        threading.Timer(0.2, os.kill, (os.getpid(), signal.{number})).start()
        # A wait in C that no signal cuts short, as little as it does a compiler.
        lock(mutex)
"""


def test_what_python_cannot_stop_is_ended():
    codes = [textwrap.dedent(IN_C).format(number=number) for number in ("SIGINT", "SIGTERM")]
    both = [
        subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
        for code in codes
    ]
    for process in both:
        assert process.communicate(timeout=15)[1] == interrupts.MESSAGE
        assert process.returncode == 130


def test_what_python_can_stop_is_interrupted_and_cleaned_up():
    before = signal.getsignal(signal.SIGTERM)
    threads = threading.active_count()
    with pytest.raises(KeyboardInterrupt), ends_in_seconds():
        os.kill(os.getpid(), signal.SIGTERM)
        signal.pause()
    assert signal.getsignal(signal.SIGTERM) == before and threading.active_count() == threads


class Tired:
    """Gets the signal to end while it is freed, where Python cannot raise an error."""

    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.1)


def test_an_interrupt_that_python_loses_is_sent_again(capfd):
    hook, reached = sys.unraisablehook, []
    with pytest.raises(KeyboardInterrupt), ends_in_seconds():
        Tired()
        reached.append("past the lost one")
        time.sleep(10.0)
        reached.append("the end")
    assert reached == ["past the lost one"] and sys.unraisablehook is hook
    assert capfd.readouterr().err == ""


def test_other_threads_and_ignored_signals_are_left_alone():
    met = []

    def elsewhere():
        with ends_in_seconds():
            met.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert met == [signal.getsignal(signal.SIGTERM)]
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with ends_in_seconds():
            os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
