"""A set of two cases with one short flight each."""

import pytest

from suite.blind import build as build_module
from suite.blind import make as make_module
from suite.blind.make import make_set
from suite.common.console import Console
from suite.diagnose.plans.trajectory import Trajectory
from tests.support.blind import NULL, SINGLE


@pytest.fixture
def short_flights(monkeypatch):
    """Every ordinary flight is one short figure eight."""

    def flights(rng):
        return [Trajectory("figure_eight", 2.0, speed=float(rng.uniform(3, 5)), size=2.0)]

    monkeypatch.setattr(build_module, "ordinary_flights", flights)


@pytest.fixture
def small_set(tmp_path, monkeypatch, short_flights):
    cases = {"case_001": SINGLE, "case_002": NULL}
    monkeypatch.setitem(make_module.DRAWERS, "mujoco", lambda seed, count: cases)
    make_set(tmp_path, 5, None, Console())
    return tmp_path
