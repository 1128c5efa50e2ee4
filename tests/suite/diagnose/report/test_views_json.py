"""What the JSON says of real flights."""

from dataclasses import replace

import pytest

from suite.diagnose.report.diagnosis_json import (
    VIEW_MEASURE,
    diagnosis_json,
    effects_json,
    headline,
)
from suite.diagnose.verdict.actuators import RotorLag
from tracks.common.files import plain


def test_each_view_names_its_own_effect_with_its_share(by_views):
    effects = {effect["name"]: effect for effect in effects_json(by_views)}
    assert effects["linear_drag"]["view"] == "force"
    assert 0.0 < effects["linear_drag"]["gap_removed"] <= 1.0
    span = effects["linear_drag"]["parameters"]["coefficient"]["ci95"][0]
    assert span[0] < 0.4 < span[1]
    assert all(effect["view"] == "torque" for n, effect in effects.items() if n != "linear_drag")


def test_the_json_has_every_axis_and_says_nothing_twice(by_views):
    told = plain(diagnosis_json(by_views))
    assert set(told["gap"]["channels"]["force"]) == {"x", "y", "z"}
    main = told["gap"]["channels"][by_views.main.view.name]
    whole = sum(axis["before"] ** 2 for axis in main.values()) ** 0.5
    assert told["gap"]["before"] == pytest.approx(whole)
    assert told["gap"]["measure"].startswith(VIEW_MEASURE.split("{")[0])
    assert told["headline"] == headline(by_views) and "linear_drag" in headline(by_views)


def test_a_lag_is_said_beside_what_is_left(by_views):
    nothing = tuple(replace(one, names=()) for one in by_views.results)
    lag = RotorLag(0.06, 0.03, 0.001, 0.9, 0.001)
    late = "with a time constant of 0.06 s instead of 0.03 s."
    left = headline(replace(by_views, results=nothing, lag=lag, label="partly"))
    assert "No effect that flights can tell" in left and left.endswith(late)
    alone = headline(replace(by_views, results=nothing, lag=lag, label="named"))
    assert alone.startswith("motor_lag") and alone.endswith(late)
    (only,) = effects_json(replace(by_views, results=nothing, lag=lag))
    entry = only["parameters"]["time_constant"]
    assert (entry["unit"], entry["value"]) == ("s", 0.06)
    assert entry["ci95"] == pytest.approx([0.059, 0.061])
