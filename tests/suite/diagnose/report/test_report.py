"""A diagnosis as JSON, tables and charts: what they show is what was found."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from suite.commands.diagnose import run as command
from suite.common.console import Console
from suite.common.report import html
from suite.diagnose import run
from suite.diagnose.config import Config
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.evidence.moments import centred
from suite.diagnose.report import charts, sections
from suite.diagnose.report.charts import series_chart
from suite.diagnose.report.diagnosis_json import (
    actuators_json,
    diagnosis_json,
    not_examined,
    parameters_json,
)
from suite.diagnose.report.page import channels_grid, page
from suite.diagnose.report.summary import NOT_IDENTIFIABLE, answer, components, in_digits
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.verdict.actuators import actuator_mismatches
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN
from tracks.common.files import plain
from tracks.common.grid import Grid


@pytest.fixture(scope="module")
def found(drag, flown):
    mismatches = actuator_mismatches(flown.logs, flown.vehicle)
    return plain({**diagnosis_json(drag), "actuators": actuators_json(mismatches)})


def texts(table):
    return [[cell.text for cell in row] for row in table.rows]


def test_another_motor_that_fits_as_well_is_not_ruled_out(drag):
    motor = Candidate("weak_motor", (0,), "weak_motor 1")
    named = NamedEffect(motor, 0.001, 100.0, (), {"weak_motor 2": 1.0, "weak_motor 3": 500.0})
    shown = SimpleNamespace(named=[(drag.main, named)])
    (table,) = sections.rivals_section(shown, {"separate_with": ["a"]}).parts
    assert [row[-1] for row in texts(table)] == ["not separable", "ruled out"]


def test_the_json_has_what_was_found(drag, found):
    assert found["verdict"] == drag.label and found["driven_by"] == "commands"
    (effect,) = found["effects"]
    assert effect["name"] == "linear_drag" and effect["gap_removed"] > 0.9
    value = np.array(effect["parameters"]["coefficient"]["value"])
    np.testing.assert_allclose(value, drag.main.theta[drag.main.search.indices])
    low, high = np.array(effect["parameters"]["coefficient"]["ci95"]).T
    assert np.all(np.abs([0.15, 0.15, 0.05] - (low + high) / 2) < high - low)
    assert found["control"]["after"] > 1.5 * found["gap"]["after"]
    assert found["gap"]["channels"]["1 s"]["velocity"]["noise_floor"] > 0.0


def test_each_view_names_its_own_effect_and_the_page_has_its_headline_first(by_views):
    found = plain(diagnosis_json(by_views))
    effects = {effect["name"]: effect for effect in found["effects"]}
    drag = effects.pop("linear_drag")
    assert drag["view"] == "force" and 0.0 < drag["gap_removed"] <= 1.0
    span = drag["parameters"]["coefficient"]["ci95"][0]
    assert span[0] < 0.4 < span[1]
    assert effects and all(effect["view"] == "torque" for effect in effects.values())
    assert set(found["gap"]["channels"]["force"]) == {"x", "y", "z"}
    main = found["gap"]["channels"][by_views.main.source.name]
    whole = sum(axis["before"] ** 2 for axis in main.values()) ** 0.5
    assert found["gap"]["before"] == pytest.approx(whole, rel=1e-9)
    assert found["headline"].startswith(answer(found)) and "linear_drag" in answer(found)
    text = html(page(by_views, found, "mass = 1", {"vehicle.toml"}))
    assert text.index(found["headline"][:40]) < text.index("data:image/png") < text.index("<table")
    assert "What was written" in text and "mass = 1" in text and "black box" in text


def test_numbers_of_views_are_those_that_are_judged_and_the_rest_has_its_reason(by_views):
    main, found = by_views.main, plain(diagnosis_json(by_views))
    gap, rest = found["gap"], found["unexplained"]
    # The error is that within flights; their constant offsets are apart.
    for name, theta in (("before", main.search.start.theta), ("after", main.theta)):
        data = main.source.held.residuals(theta)
        within = centred(data.residual, data.flight)
        assert gap[name] == pytest.approx(np.sqrt((within**2).sum(axis=1).mean()))
        offset = gap["offset"][main.source.name][name]
        total = np.sqrt((data.residual**2).sum(axis=1).mean())
        assert total == pytest.approx(np.hypot(gap[name], offset))
    # Share, table and reasons agree with the error and the noise floor.
    left = (gap["after"] - gap["noise_floor"]) / (gap["before"] - gap["noise_floor"])
    assert rest["share"] == pytest.approx(left) and rest["judged"] == by_views.verdict.share_left
    held = sections.evidence_section(by_views, found).parts[-1]
    assert isinstance(held, Grid) and texts(held)[-1][3] == f"{100 * (1 - left):.0f} %"
    above = {one["view"] for one in rest["above_noise"]}
    assert above == {
        one.source.name for one in by_views.findings if one.after.rms > 1.5 * one.after.floor
    }
    loud = {**rest, "where": None, "above_noise": [
        {"view": "torque", "error": 4.78, "noise_floor": 0.15, "unit": "rad/s^2",
         "reason": "that logged signals hardly predict"}]}  # fmt: skip
    words, table = sections.residual_section({**found, "unexplained": loud}).parts[:2]
    assert words == "Above the noise floor remains an error that logged signals hardly predict."
    assert isinstance(table, Grid) and texts(table)[0][:3] == ["torque", "4.78 rad/s²", "0.15"]


def test_parts_of_the_dynamics_that_no_source_tests_are_listed(
    by_views, drag, monkeypatch, capsys, tmp_path
):
    assert not_examined(drag) == []
    assert not_examined(by_views) == ["rate loop"]
    force = replace(by_views, findings=by_views.findings[:1])
    found = plain(diagnosis_json(force))
    assert found["not_examined"] == ["torque", "rate loop"] and found["verdict"] == "named"
    assert "torque, rate loop" in html(page(force, found, "", set()))
    # The console prints them under each verdict.
    monkeypatch.setattr(run, "diagnose_files", lambda *_: {**found, "warnings": []})
    command(Config(flights=(tmp_path,), vehicle="v", out=tmp_path), Console())
    said = capsys.readouterr().out
    assert "verdict: named" in said and said.count("not examined: torque, rate loop\n") == 1


def test_components_are_named_by_axis_and_shown_in_digits_that_the_interval_supports():
    entry = {"value": [0.012, 0.0004, None], "ci95": [[0.0119, 0.0121], [-0.001, 0.0018], None],
             "unit": "m"}  # fmt: skip
    x, y, z = components({"name": "com_offset", "parameters": {"offset": entry}})
    assert (x.label, x.texts()) == ("offset x [m]", ("0.01200", "0.01190 to 0.01210"))
    assert x.is_significant and not y.is_significant and not z.is_significant
    assert y.texts() == ("not different from 0", "-0.0010 to 0.0018")
    assert z.texts() == (NOT_IDENTIFIABLE, "")
    small = {"value": 1.21e-6, "ci95": [1.1e-6, 1.3e-6], "unit": "kg/rad"}
    (only,) = components({"name": "rotor_drag", "parameters": {"coefficient": small}})
    assert only.texts() == ("1.21e-06", "1.10e-06 to 1.30e-06")
    assert in_digits(1234.56, (1234.56, 1200.0, 1270.0)) == "1235"


def test_a_weak_motor_has_its_number_and_the_motors_that_it_may_be():
    space = make_space(PLAIN)
    at = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    theta, width = space.array("start"), dict.fromkeys(at, 0.01)
    unsure = parameters_json(space, "weak_motor", [at[1]], theta, width, undecided=[at[2]])
    assert (unsure["index"]["value"], unsure["index"]["ci95"]) == (2, [2, 3])
    several = parameters_json(space, "weak_motor", [at[1], at[3]], theta, width)
    assert several["index"] == {"value": [2, 4], "unit": "1", "ci95": [[2, 2], [4, 4]]}
    labels = [one.label for one in components({"name": "weak_motor", "parameters": several})]
    assert labels == ["scale 2 [1]", "scale 4 [1]"]


def test_sections_show_the_numbers(drag, found):
    noise = sections.noise_section(drag).parts[1]
    assert isinstance(noise, Grid) and texts(noise)[0][0] == "position [m]"
    assert len(sections.actuators_section(found)) == 1
    assert sections.actuators_section({**found, "actuators": []}) == []
    rest = {**found, "unexplained": {"where": "a shape", "share": 0.25, "above_noise": []}}
    words = str(sections.residual_section(rest).parts[0])
    assert words.startswith("25 % of the error of rollouts") and words.endswith(": a shape.")
    assert "No structure beyond" in str(sections.residual_section(found).parts[0])
    held = sections.evidence_section(drag, found).parts[-1]
    assert isinstance(held, Grid) and texts(held)[-1][0] == "with the named effects"
    tried = sections.candidates_section(drag).parts[0]
    assert isinstance(tried, Grid) and len(tried.rows) > 10
    assert [row[0] for row in texts(tried) if row[3] == "named"] == ["linear_drag"]
    # A channel that no log measured is not in the table.
    none = {"before": 0.0, "after": 0.0, "noise_floor": 1e-12}
    every = found["gap"]["channels"].items()
    table = channels_grid({horizon: {**groups, "velocity": none} for horizon, groups in every})
    assert not any("velocity" in row[1] for row in texts(table)) and len(table.rows) > 3


def test_a_log_is_shown_with_duration_rate_holes_and_signals():
    log = fly(PLAIN, 0, duration_s=3.0, motors=True)
    log.pos_w[30:60] = np.nan
    (row,) = texts(sections.logs_section([log]).parts[0])
    assert row[1:6] == ["3.0 s", "301", "100 Hz", "10 ms", "10.0 %"]
    assert row[7] == "commands, velocity, rotor speeds"


def test_the_chart_shows_measured_next_to_simulated(drag, monkeypatch):
    main = drag.main
    series = main.source.series(main.search)
    monkeypatch.setattr(charts, "png", lambda figure: figure.axes[0])
    axes: Any = series_chart(series)
    labels = [line.get_label() for line in axes.lines if not line.get_label().startswith("_")]
    assert labels == ["measured", *series.simulated] and len(series.simulated) == 2
