"""Broken logs end in a verdict with warnings or in an error that says what is wrong."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from suite.common.report import html
from suite.diagnose.diagnose import diagnose
from suite.diagnose.report.diagnosis_json import checks_json, diagnosis_json
from suite.diagnose.report.page import page
from suite.diagnose.verdict.checks import run_checks
from tests.support.broken_logs import BREAKAGES
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, with_effects, with_lag
from tracks.common.files import plain, to_json

LAGGED = with_lag(PLAIN, 0.03)
TRUTH = with_effects(LAGGED, linear_drag=((0.15, 0.15, 0.05),))
VERDICTS = ("no_gap", "named", "partly", "unknown")


@pytest.fixture(scope="module")
def sound():
    return [fly(TRUTH, seed, duration_s=5.0, motors=True) for seed in range(3)]


def outcome(logs, drive="commands"):
    """The JSON of a diagnosis that went through all its steps, or the message of its refusal."""
    try:
        result = diagnose(logs, LAGGED, drive)
    except ValueError as error:
        assert len(str(error)) > 20
        return str(error)
    checks = run_checks(result)
    found = {**diagnosis_json(result), **checks_json(checks, 0)}
    text = to_json(plain(found))
    assert "NaN" not in text and "Infinity" not in text
    assert "<h2>" in html(page(result, json.loads(text), checks, "", set()))
    assert found["verdict"] in VERDICTS
    assert np.isfinite(found["gap"]["before"]) and np.isfinite(found["gap"]["after"])
    return found


@pytest.mark.parametrize(
    "breakages",
    [BREAKAGES[first : first + 3] for first in range(0, len(BREAKAGES), 3)],
    ids=lambda group: "-".join(breakage.__name__ for breakage in group),
)
def test_broken_flights_among_sound_ones(sound, breakages):
    rng = np.random.default_rng(0)
    broken = [breakage(log, rng) for breakage, log in zip(breakages, sound, strict=False)]
    found = outcome([*broken, *sound[1:]])
    assert isinstance(found, dict), found


@pytest.mark.slow
@pytest.mark.parametrize("breakage", BREAKAGES, ids=lambda f: f.__name__)
def test_one_broken_flight_among_sound_ones(sound, breakage):
    rng = np.random.default_rng(0)
    found = outcome([breakage(sound[0], rng), *sound[1:]])
    assert isinstance(found, dict), found


@pytest.mark.slow
@pytest.mark.parametrize("breakage", BREAKAGES, ids=lambda f: f.__name__)
@pytest.mark.parametrize("drive", ["commands", "motors", "auto"])
def test_every_flight_broken_alike(sound, breakage, drive):
    rng = np.random.default_rng(1)
    outcome([breakage(log, rng) for log in sound], drive)


@pytest.mark.slow
@settings(max_examples=40)
@given(st.lists(st.sampled_from(BREAKAGES), min_size=1, max_size=4), st.integers(0, 2**16))
def test_flights_broken_in_several_ways(sound, breakages, seed):
    rng = np.random.default_rng(seed)
    logs = list(sound)
    for breakage in breakages:
        k = int(rng.integers(len(logs)))
        if len(logs[k].time_s) > 30:
            logs[k] = breakage(logs[k], rng)
    outcome(logs)
