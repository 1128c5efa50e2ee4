"""What has changed since reference flights, and how far flights of one vehicle are apart."""

from dataclasses import replace

import numpy as np
import pytest

from suite.diagnose.data.flights import ready
from suite.diagnose.data.view import FORCE, TORQUE
from suite.diagnose.estimate.parameters import candidates, make_space
from suite.diagnose.evidence.moments import ForceModel
from suite.diagnose.evidence.views import ViewEvidence, view_candidates
from suite.diagnose.search.chance import RotorSpread, rotor_spread
from suite.diagnose.search.change import change_evidence
from suite.diagnose.search.search import search
from suite.diagnose.thresholds import THRESHOLDS
from tests.support.real_flights import VEHICLE, flights

SPACE = make_space(VEHICLE)
DRAG = (0.4, 0.3, 0.2)


def task_of(logs, view=FORCE):
    smoothed = ready(logs, VEHICLE).smoothed[view.name]
    return ViewEvidence(view, ForceModel(VEHICLE, SPACE, False), smoothed)


def changes(logs, references):
    among, found = candidates(SPACE, False, ()), {}
    before = [task_of(references, view) for view in (FORCE, TORQUE)]
    after = [task_of(logs, view) for view in (FORCE, TORQUE)]
    spread = rotor_spread([*before, *after])
    for reference, task in zip(before, after, strict=True):
        evidence, start = change_evidence(reference, task.flights, spread)
        known = evidence.relinearise(start)
        result = search(evidence, start, view_candidates(among, known[1]), known=known)
        found[task.view.name] = [name.candidate.label for name in result.named]
    return found


def test_a_change_stands_out_of_how_flights_differ_though_the_file_is_wrong():
    wrong = {"thrust_scale": (0.9,), "linear_drag": (DRAG,)}
    references = flights(3, seed=5, speed=1.0, **wrong)
    weak = flights(3, seed=6, speed=1.0, weak_motor=((1.0, 1.0, 0.8, 1.0),), **wrong)
    assert "weak_motor 3" in changes(weak, references)["torque"]
    assert changes(flights(3, seed=7, speed=1.0, **wrong), references) == {
        "force": [],
        "torque": [],
    }


def test_only_what_comes_near_the_best_stands_in_its_place():
    """Otherwise a more usual effect replaces the right one, and held-out flights refute it."""
    weak = flights(3, seed=6, speed=1.0, weak_motor=((1.0, 1.0, 0.8, 1.0),))
    before, after = (task_of(logs, TORQUE) for logs in (flights(3, seed=5, speed=1.0), weak))
    evidence, start = change_evidence(before, after.flights, rotor_spread([before, after]))
    block = evidence.linearise(start)
    among = view_candidates(candidates(SPACE, False, ()), block)
    found = evidence.scores(block, block.equations, start.theta, [], among, 0)
    assert 0 < len(found) < len(among)
    assert found[-1].gain >= THRESHOLDS.near_share * found[0].gain


def test_an_axis_along_which_flights_are_alike_counts_for_itself_beside_the_others():
    logs = flights(3, seed=5, trim=0.0)
    force, torque = task_of(logs), task_of(logs, TORQUE)
    apart = [
        flight._replace(measured=flight.measured + push * np.array([1.0, 1.0, 0.1]))
        for flight, push in zip(torque.flights, (-2.0, 0.0, 2.0), strict=True)
    ]
    spread = rotor_spread([force, replace(torque, flights=apart)])
    prior, own = THRESHOLDS.spread_freedom, 2
    assert spread.freedom == 4 * own
    assert {view: list(one) for view, one in spread.freedom_along.items()} == {
        "force": [0, 0, own],
        "torque": [own, own, own],
    }
    quiet = spread.share * np.sqrt(prior / (prior + own))
    assert quiet <= spread.along["force"][2] < 1.05 * quiet
    assert (spread.along["torque"] > spread.share).all()


def test_sizes_are_drawn_as_the_spread_is_estimated():
    spread = RotorSpread(0.01, 8, {}, {"force": np.array([0, 0, 2]), "torque": np.full(3, 2)}, 4)
    sizes = {
        view: spread.variance_ratios(view, 20000, np.random.default_rng(1))
        for view in ("force", "torque")
    }
    assert sizes["force"].mean(axis=0) == pytest.approx(np.ones(3), rel=0.02)
    # Axes that nothing is told of have the spread of all: a chi-square of 8 degrees over 8.
    assert sizes["force"][:, 0].var() == pytest.approx(2.0 / 8.0, rel=0.05)
    own, shared = 2.0 * 2.0, 2.0 * 8.0  # variances of the sums of squares
    both = (4.0 / 8.0) ** 2 * shared + own + 2.0 * (4.0 / 8.0) * own
    assert sizes["torque"].var(axis=0) == pytest.approx(np.full(3, both / 36.0), rel=0.05)
