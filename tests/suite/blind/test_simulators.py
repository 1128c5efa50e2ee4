"""Who flies a case: what the diagnosis is given of it, and what it is not."""

import numpy as np
import pytest

from suite.blind import build as module
from suite.blind.build import build
from suite.blind.cases import Case
from suite.blind.continuous.timing import draw_conditions
from suite.blind.simulators import simulator_for

SINGLE = Case(
    "single", ("linear_drag",), 6.0, "bare", "estimator", (6, 70_001), simulator="continuous"
)
pytestmark = pytest.mark.usefixtures("short_flights")


def test_a_continuous_cases_vehicle_has_the_loop_that_flew(monkeypatch):
    """That a flight is the same to the bit again, test_continuous_flight.py asks."""
    judged = []
    monkeypatch.setattr(module, "_expected_names", lambda *given: judged.append(given) or {})
    first = build(SINGLE)
    conditions = first.answer["conditions"]
    assert first.nominal.controller.frequency == conditions["loop_hz"]
    assert first.nominal.name == "bare" and not first.nominal.effects
    assert first.logs[0].integrator is None
    about = dict(first.logs[0].about)
    assert about == {"source": "suite blind", "vehicle": "bare"}, "nothing of the conditions"
    spacing = np.median(np.diff(first.logs[0].time_s))
    assert spacing == pytest.approx(1.0 / conditions["row_hz"], rel=0.1)
    # Its strength is worked out on the flight as it was, without noise.
    ((_, nominal, (exact,), _, named),) = judged
    assert nominal == first.nominal and list(named) == ["linear_drag"]
    jumps = [np.diff(log.vel_w, 2, axis=0).std() for log in (exact, first.logs[0])]
    assert jumps[0] < 0.1 * jumps[1]


@pytest.mark.slow
def test_a_continuous_case_is_as_strong_as_it_says():
    """Thirty sigma on flights like those of the table; this one is short."""
    hidden = build(SINGLE).answer["effects"][0]
    assert hidden["sigma"] > 2.0 and "linear_drag" not in hidden["allowed"]


def test_conditions_are_drawn_from_the_cases_seed():
    simulator = simulator_for(SINGLE, np.random.default_rng(3))
    drawn = draw_conditions(np.random.default_rng(3))
    assert simulator.conditions["row_hz"] == drawn.row_hz
    assert simulator.nominal.controller.frequency == drawn.loop_hz
    assert not simulator_for(
        Case("null", (), 0.0, "bare", "full", (1, 1)), np.random.default_rng()
    ).conditions
