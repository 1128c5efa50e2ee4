"""Diagnoses that many tests share; code that is compiled here is optimised."""

import contextlib
import io
import os

import jax
import pytest

from eval.logs.flight_log import write_flight
from eval.quadrotor.vehicle_file import save_vehicle
from suite.cli import main
from suite.diagnose import run
from suite.diagnose.diagnose import diagnose
from suite.diagnose.sources.rollout_source import rollouts_of
from tests.support.diagnosis_flights import fly, fly_all
from tests.support.real_flights import VEHICLE, flights
from tests.support.vehicles import LAGGED, PLAIN, with_effects

UNOPTIMISED = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] != "0"
"""The setting of tests/conftest.py, or of the caller."""


def pytest_runtest_setup():
    """Optimise what is compiled from here on: diagnoses run for longer than they compile."""
    jax.config.update("jax_disable_most_optimizations", False)


def pytest_runtest_teardown():
    """Compile for other tests as before."""
    jax.config.update("jax_disable_most_optimizations", UNOPTIMISED)


@pytest.fixture
def compiled_quickly():
    """Optimise nothing: for programs that run once or twice."""
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="session")
def log():
    """Return one flight of the plain vehicle."""
    return fly(PLAIN, 0, duration_s=4.0, motors=True)


@pytest.fixture(scope="session")
def diagnosed(tmp_path_factory):
    """Diagnose three flights with a hidden drag by the command; return its folder and result."""
    folder = tmp_path_factory.mktemp("diagnosis")
    truth = with_effects(LAGGED, linear_drag=((0.15, 0.15, 0.05),))
    logs = fly_all([truth] * 3, range(3), duration_s=4.0, motors=True)
    paths = [str(write_flight(folder / f"{k}.parquet", log)) for k, log in enumerate(logs)]
    bad = folder / "bad.csv"
    bad.write_text("time,pos_x\n0,1\n", encoding="utf-8")
    save_vehicle(LAGGED, folder / "v.toml")
    out = folder / "out"
    line = [*paths, str(bad), "--vehicle", str(folder / "v.toml"), "--out", str(out), "--plan"]
    said, made = io.StringIO(), []

    def kept(*args, **options):
        made.append(diagnose(*args, **options))
        return made[0]

    with contextlib.redirect_stdout(said), pytest.MonkeyPatch.context() as patch:
        patch.setattr(run, "diagnose", kept)
        assert main(["diagnose", *line, "--drive", "commands", "--seed", "3", "--json"]) == 0
    (folder / "said.json").write_text(said.getvalue(), encoding="utf-8")
    return out, made[0]


@pytest.fixture(scope="session")
def drag(diagnosed):
    """Return the diagnosis."""
    return diagnosed[1]


@pytest.fixture(scope="session")
def found_drag(drag):
    """Return what its rollouts show."""
    return drag.main


@pytest.fixture(scope="session")
def flown(drag):
    """Return its rollouts."""
    return rollouts_of(drag.main)


@pytest.fixture(scope="session")
def by_views():
    """Return a diagnosis of two effects by views."""
    hidden = {"linear_drag": ((0.4, 0.3, 0.2),), "angular_damping": ((6.0, 6.0, 4.0),)}
    return diagnose(flights(4, 0, 4.0, hidden=hidden), VEHICLE, by="views")
