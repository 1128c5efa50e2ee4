"""One diagnosis of a hidden drag, for the tests of what is said of it; code here is optimised."""

import os

import jax
import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.verdict.checks import run_checks
from tests.support.diagnosis_flights import fly_all
from tests.support.vehicles import PLAIN, with_effects, with_lag

UNOPTIMISED = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] != "0"
"""As tests/conftest.py, or who calls, says."""


def pytest_runtest_setup():
    """Optimise what is compiled from here on: diagnoses run for longer than they compile."""
    jax.config.update("jax_disable_most_optimizations", False)


def pytest_runtest_teardown():
    """Compile for other tests as before."""
    jax.config.update("jax_disable_most_optimizations", UNOPTIMISED)


@pytest.fixture(scope="session")
def drag():
    """Return the diagnosis of three flights with a drag that the vehicle file lacks."""
    given = with_lag(PLAIN, 0.03)
    truth = with_effects(given, linear_drag=((0.15, 0.15, 0.05),))
    logs = fly_all([truth] * 3, range(3), duration_s=4.0, motors=True)
    return diagnose(logs, given, "commands")


@pytest.fixture(scope="session")
def drag_checks(drag):
    """Return what stands beside its names."""
    return run_checks(drag)
