"""A set of two cases with one short flight each."""

import shutil

import pytest

from eval.flights.trajectory import Trajectory
from suite.blind import build as build_module
from suite.blind import make as make_module
from suite.blind.make import make_set
from suite.common.console import Console
from tests.support.blind import NULL, SINGLE


def shorten(monkeypatch):
    """Make every ordinary flight one short figure eight, and a set's cases two."""

    def flights(rng):
        return [Trajectory("figure_eight", 2.0, speed=float(rng.uniform(3, 5)), size=2.0)]

    cases = {"case_001": SINGLE, "case_002": NULL}
    monkeypatch.setattr(build_module, "ordinary_flights", flights)
    monkeypatch.setitem(make_module.DRAWERS, "mujoco", lambda seed, count: cases)


@pytest.fixture
def short_flights(monkeypatch):
    shorten(monkeypatch)


@pytest.fixture(scope="session")
def made_set(tmp_path_factory):
    """Return the folder of a set that no test changes."""
    folder = tmp_path_factory.mktemp("blind")
    with pytest.MonkeyPatch.context() as patch:
        shorten(patch)
        make_set(folder, 5, None, Console())
    return folder


@pytest.fixture
def small_set(made_set, tmp_path, short_flights):
    return shutil.copytree(made_set, tmp_path / "set")
