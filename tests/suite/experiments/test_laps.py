"""Laps beside plans at a small size: what is planned as one piece, kept, and shown."""

import pytest

from eval.judging.judge import JudgeOptions, fly
from eval.worlds.trial import Rules, TrialSpec
from suite.experiments import laps
from suite.experiments.planning.search import Plan
from tests.support.documents import page, reproduce
from tests.support.laps import flown


@pytest.fixture
def planner(monkeypatch):
    """Return the pieces that were planned; plans are made up, policies fly for a second."""
    pieces = []

    def plans(vehicle, trials, effort, tell):
        pieces.append(list(trials))
        return [Plan(trial, [0.5], 2.0, True, "finished", 2.0) for trial in trials]

    def short(policy, trials, vehicle, world, options, keep, record):
        asked = JudgeOptions(slots=4, workers=1, rules=Rules(time_limit_s=0.5))
        return fly(policy, trials, vehicle, world, asked, keep, record)

    monkeypatch.setattr(laps, "plans", plans)
    monkeypatch.setattr(laps, "fly_plan", lambda vehicle, trial, n: flown(2.0, trial=trial))
    monkeypatch.setattr(laps, "fly", short)
    return pieces


def test_plans_are_made_in_pieces_and_found_again(planner, tmp_path):
    args = ["--policy", "racer", "--difficulty", "0", "--trials"]
    assert reproduce(tmp_path, "laps", *args, "2") == 0
    assert [len(piece) for piece in planner] == [2, 2, 2]
    assert planner[0] == [TrialSpec("zigzag", 0, 0), TrialSpec("zigzag", 0, 1)]
    text, numbers = page(tmp_path, "laps")
    assert "racer finishes none of them" in text and "no track that a plan and a policy" in text
    assert [plan["lap_s"] for plan in numbers["plans"]] == [2.0] * 6
    assert len(numbers["laps"]["racer"]) == 6 and numbers["laps"]["racer"][0]["ratio"] is None
    assert reproduce(tmp_path, "laps", *args, "3") == 0
    assert planner[3:] == [[TrialSpec(track, 0, 2)] for track in ("zigzag", "circular", "ellipse")]
