"""numpy's products take one thread, unless the user said otherwise."""

import os

import pytest

from suite.cli import main
from suite.common.running.threads import one_thread_a_product


def test_what_a_user_set_stays():
    own = {"OMP_NUM_THREADS": "3"}
    one_thread_a_product(own)
    assert own == {"OMP_NUM_THREADS": "3"}


def test_a_command_sets_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    assert main(["effects"]) == 0
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
