"""A diagnosis as JSON, tables and charts, and the first screen of its report."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from eval.effects.interface import Sample
from suite.commands.diagnose import run as command
from suite.common.console import Console
from suite.common.report import html
from suite.diagnose import run
from suite.diagnose.config import Config
from suite.diagnose.diagnose import Verdict
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.evidence.view_means import centred
from suite.diagnose.report import charts, sections, summary
from suite.diagnose.report import diagnosis_json as as_json
from suite.diagnose.report.charts import series_chart
from suite.diagnose.report.page import channels_grid, page
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.source import FITTED, GIVEN
from suite.diagnose.verdict.actuators import actuator_mismatches
from suite.diagnose.verdict.gap import Gap
from tests.support.vehicles import PLAIN, with_effects
from tracks.common.files import plain
from tracks.geometry.rotation import exp_rot, quat_to_rot


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    """Draw no pictures: tests/suite/diagnose/test_run.py has pages with theirs."""
    monkeypatch.setattr(charts, "png", lambda figure: b"a picture")


@pytest.fixture(scope="module")
def found(drag, flown):
    mismatches = actuator_mismatches(flown.logs, flown.vehicle)
    return plain(
        {**as_json.diagnosis_json(drag), "actuators": [one._asdict() for one in mismatches]}
    )


def texts(table: Any):
    return [[cell.text for cell in row] for row in table.rows]


def test_another_motor_that_fits_as_well_is_not_ruled_out(drag):
    motor = Candidate("weak_motor", (0,), "weak_motor 1")
    named = NamedEffect(motor, 0.001, 100.0, (), {"weak_motor 2": 1.0, "weak_motor 3": 500.0})
    shown = SimpleNamespace(named=[(drag.main, named)])
    (table,) = sections.rivals_section(shown, {"separate_with": ["a"]}).parts
    assert [row[-1] for row in texts(table)] == ["not separable", "ruled out"]


def test_the_json_has_what_was_found(drag, found):
    assert found["verdict"] == drag.verdict.label and found["driven_by"] == "commands"
    (effect,) = found["effects"]
    assert effect["name"] == "linear_drag" and effect["gap_removed"] > 0.9
    coefficient, named = effect["parameters"]["coefficient"], drag.main.search.indices
    np.testing.assert_allclose(coefficient["value"], drag.main.theta[named])
    low, high = np.array(coefficient["ci95"]).T
    assert np.all(np.abs([0.15, 0.15, 0.05] - (low + high) / 2) < high - low)
    assert found["control"]["after"] > 1.5 * found["gap"]["after"]
    assert found["gap"]["channels"]["1 s"]["velocity"]["noise_floor"] > 0.0
    # A change since reference flights is named whatever its size, and then its size is compared.
    limits = replace(drag.main.source.limits, relevance=(1e6, 1e6, 1e6))
    for names_small in (True, False):
        source = replace(drag.main.source, limits=limits, names_small=names_small)
        findings = (replace(drag.main, source=source),)
        (effect,) = as_json.effects_json(replace(drag, findings=findings))
        assert effect["relevant"] is not names_small


def test_each_view_names_its_own_effect_and_the_page_has_its_headline_first(by_views):
    found = plain(as_json.diagnosis_json(by_views))
    effects = {effect["name"]: effect for effect in found["effects"]}
    drag = effects.pop("linear_drag")
    low, high = drag["parameters"]["coefficient"]["ci95"][0]
    assert drag["view"] == "force" and 0.0 < drag["gap_removed"] <= 1.0 and low < 0.4 < high
    assert effects and all(effect["view"] == "torque" for effect in effects.values())
    assert set(found["gap"]["channels"]["force"]) == {"x", "y", "z"}
    findings = tuple(replace(one, names=()) for one in by_views.findings)
    nameless = replace(by_views, findings=findings, verdict=Verdict("no_gap"))
    for diagnosis in (by_views, nameless):
        assert as_json.diagnosis_json(diagnosis)["views"] == ["force", "torque"]
    answer = summary.answer(found)
    assert found["headline"].startswith(answer) and "linear_drag" in answer
    text = html(page(by_views, found, "mass = 1", {"vehicle.toml"}))
    assert text.index(found["headline"][:40]) < text.index("data:image/png") < text.index("<table")
    assert "What was written" in text and "mass = 1" in text and "black box" in text
    assert "x [m/s²]" in text and "x [rad/s²]" in text


def test_numbers_of_views_are_those_that_are_judged_and_the_rest_has_its_reason(by_views):
    main, found = by_views.main, plain(as_json.diagnosis_json(by_views))
    gap, rest = found["gap"], found["unexplained"]
    axes = gap["channels"][main.source.name].values()
    whole = sum(axis["before"] ** 2 for axis in axes) ** 0.5
    assert gap["before"] == pytest.approx(whole, rel=1e-9)
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
    held = texts(sections.evidence_section(by_views, found).parts[-1])
    assert held[-1][3] == f"{100 * (1 - left):.0f} %"
    above = [one.source.name for one in by_views.findings if one.after.rms > 1.5 * one.after.floor]
    assert {one["view"] for one in rest["above_noise"]} == set(above)
    torque = {"view": "torque", "error": 4.78, "noise_floor": 0.15, "unit": "rad/s^2"}
    torque["reason"] = "that logged signals hardly predict"
    loud = {**rest, "where": None, "above_noise": [torque]}
    words, table = sections.residual_section({**found, "unexplained": loud}).parts[:2]
    assert words == "Above the noise floor remains an error that logged signals hardly predict."
    assert texts(table)[0][:3] == ["torque", "4.78 rad/s²", "0.15"]


def test_no_share_is_above_one_and_a_single_stretch_has_no_interval():
    before, after = (Gap(np.array([score]), np.ones(1), {}) for score in (1.44, 0.9))
    main = SimpleNamespace(before=before, after=after, names=(1,), without={}, control=None)
    main.source = SimpleNamespace(measure="RMS")
    shown = SimpleNamespace(main=main, seed=0)
    rows = texts(sections.evidence_section(shown, {"gap": {"held_out": ["a"]}}).parts[-1])
    assert rows == [["as given", "1.2", "", ""], ["with the named effects", "0.949", "", "100 %"]]


def test_what_no_source_tests_is_listed(by_views, drag, monkeypatch, capsys, tmp_path):
    """On the page and, under each verdict, on the console."""
    assert as_json.not_examined(drag) == []
    assert as_json.not_examined(by_views) == ["rate loop"]
    force = replace(by_views, findings=by_views.findings[:1])
    found = plain(as_json.diagnosis_json(force))
    assert found["not_examined"] == ["torque", "rate loop"] and found["verdict"] == "named"
    assert "torque, rate loop" in html(page(force, found, "", set()))
    monkeypatch.setattr(run, "diagnose_files", lambda *_: {**found, "warnings": []})
    command(Config(flights=(tmp_path,), vehicle="v", out=tmp_path), Console())
    said = capsys.readouterr().out
    assert "verdict: named" in said and said.count("not examined: torque, rate loop\n") == 1


def test_components_are_named_by_axis_and_shown_in_digits_that_the_interval_supports():
    entry = {"value": [0.012, 0.0004, None], "ci95": [[0.0119, 0.0121], [-0.001, 0.0018], None],
             "unit": "m"}  # fmt: skip
    entry["file"] = [0.0, 0.0, None]
    x, y, z = summary.components({"name": "com_offset", "parameters": {"offset": entry}})
    assert (x.label, x.texts()) == ("offset x [m]", ("0.01200", "0.01190 to 0.01210"))
    assert x.is_significant and not y.is_significant and not z.is_significant
    assert y.texts() == ("0.0004 (not different from 0)", "-0.0010 to 0.0018")
    assert z.texts() == ("not identifiable", "")
    small = {"value": 1.21e-6, "ci95": [1.1e-6, 1.3e-6], "unit": "kg/rad"}
    (only,) = summary.components({"name": "rotor_drag", "parameters": {"coefficient": small}})
    assert only.texts() == ("1.21e-06", "1.10e-06 to 1.30e-06")
    assert summary.in_digits(1234.56, (1234.56, 1200.0, 1270.0)) == "1235"


def test_a_weak_motor_has_its_number_and_the_motors_that_it_may_be():
    space = make_space(PLAIN)
    at = [i for i, entry in enumerate(space.entries) if entry.effect == "weak_motor"]
    theta, width = space.array("start"), dict.fromkeys(at, 0.01)
    unsure = as_json.parameters_json(space, "weak_motor", [at[1]], theta, width, undecided=[at[2]])
    assert (unsure["index"]["value"], unsure["index"]["ci95"]) == (2, [2, 3])
    index = summary.components({"name": "weak_motor", "parameters": unsure})[0]
    assert index.texts() == ("2", "2 to 3")
    several = as_json.parameters_json(space, "weak_motor", [at[1], at[3]], theta, width)
    assert several["index"] == {"value": [2, 4], "unit": "1", "ci95": [[2, 2], [4, 4]]}
    assert several["scale"]["file"] == [1.0, 1.0]
    shown = summary.components({"name": "weak_motor", "parameters": several})
    assert [one.label for one in shown] == ["scale 2 [1]", "scale 4 [1]"]
    # A motor that is weak in the vehicle file stays so, and is in the total.
    given = make_space(with_effects(PLAIN, weak_motor=((0.9, 1.0, 1.0, 1.0),)))
    theta = given.array("start")
    theta[at[2]], half = 0.8, {at[2]: 0.01}
    total = as_json.parameters_json(given, "weak_motor", [at[2]], theta, half, undecided=[at[3]])
    assert total["index"] == {"value": [1, 3], "unit": "1", "ci95": [[1, 1], [3, 4]]}
    assert total["scale"]["value"] == [0.9, 0.8] and total["scale"]["ci95"][0] is None
    shown = summary.components({"name": "weak_motor", "parameters": total})
    assert [(one.label, one.texts()[0], one.is_significant) for one in shown] == [
        ("scale 3 [1]", "0.800", True),
        ("scale 1 [1]", "0.9", False),
    ]
    assert [
        as_json.rotor_place((x, y, 0.0)) for x, y in ((0.1, 0.1), (-0.1, 0.0), (0.0, -0.1))
    ] == [
        "front left",
        "rear",
        "right",
    ]


def test_sections_show_the_numbers(drag, found):
    assert texts(sections.noise_section(drag).parts[1])[0][0] == "position [m]"
    assert len(sections.actuators_section(found).parts) == 2
    assert "Actuators" not in html(page(drag, {**found, "actuators": []}, "", set()))
    bare = [replace(one, search=replace(one.search, first=[])) for one in drag.findings]
    assert "The candidates" not in html(page(replace(drag, findings=bare), found, "", set()))
    rest = {**found, "unexplained": {"where": "a shape", "share": 0.25, "above_noise": []}}
    words = str(sections.residual_section(rest).parts[0])
    assert words.startswith("25 % of the error of rollouts") and words.endswith(": a shape.")
    assert "No structure beyond" in str(sections.residual_section(found).parts[0])
    held = texts(sections.evidence_section(drag, found).parts[-1])
    assert held[-1][0] == "with the named effects"
    tried = texts(sections.candidates_section(drag).parts[0])
    assert len(tried) > 10 and [row[0] for row in tried if row[3] == "named"] == ["linear_drag"]
    # A channel that no log measured is not in the table.
    none = {"before": 0.0, "after": 0.0, "noise_floor": 1e-12}
    every = found["gap"]["channels"].items()
    none["repeatability"] = None
    rows = {horizon: {**groups, "velocity": none} for horizon, groups in every}
    table = channels_grid(rows, {})
    assert "repeatability" not in table.headers
    assert not any("velocity" in row[1] for row in texts(table)) and len(table.rows) > 3


def test_a_log_is_shown_with_duration_rate_holes_and_signals(log):
    in_hole = (np.arange(len(log.time_s)) // 40 == 1)[:, None]
    holed = replace(log, pos_w=np.where(in_hole, np.nan, log.pos_w))
    (row,) = texts(sections.logs_section([holed]).parts[0])
    assert row[1:6] == ["4.0 s", "401", "100 Hz", "10 ms", "10.0 %"]
    assert row[7] == "commands, velocity, rotor speeds"


def test_the_chart_shows_measured_next_to_simulated(drag, monkeypatch):
    series = drag.main.source.series(drag.main.search)
    monkeypatch.setattr(charts, "png", lambda figure: figure.axes)
    over, below = cast(Any, series_chart(series))
    labels = [line.get_label() for line in over.lines if not line.get_label().startswith("_")]
    assert labels == ["measured", *series.simulated] and len(series.simulated) == 2
    for line, simulated in zip(below.lines, series.simulated.values(), strict=True):
        np.testing.assert_array_equal(line.get_ydata(), series.measured - simulated)
    given, named = (np.nanstd(line.get_ydata()) for line in below.lines)
    assert named < 0.2 * given


def test_what_remains_of_a_partly_explained_gap_is_in_the_chart(drag, flown, found):
    search, rollouts = drag.main.search, flown.simulated(drag.main.search)
    rollouts[1][FITTED][..., 2] += 30.0  # in the position along z
    assert "world z" not in flown.series(search, rollouts).label
    assert flown.series(search, rollouts, FITTED).label == "Position along world z [m]"
    for verdict, worst in (("named", GIVEN), ("partly", FITTED)):
        text = html(page(drag, {**found, "verdict": verdict}, "", set(), rollouts))
        assert f"in units of noise when {worst}." in text


def test_a_simulation_that_turns_far_is_recorded_where_it_turned():
    """The residual has the sine of the angle, which is the same for 60 and 120 degrees."""
    row_s, axis = np.linspace(0.0, 1.0, 101), np.array([0.6, 0.0, 0.8])
    turn = 1.5 * np.pi * np.sin(np.pi * row_s / 1.6)[:, None] * axis  # to 270 degrees and back
    still = np.zeros((101, 3))
    rot_w = np.tile(exp_rot(np.array([0.3, 1.0, -0.5])), (101, 1, 1))
    residual = np.zeros((101, 19))
    residual[:, 3:6] = -np.sin(1.5 * np.pi * np.sin(np.pi * row_s / 1.6))[:, None] * axis
    residual[:, 9:12] = -np.gradient(turn, row_s, axis=0)
    row = Sample(still, rot_w, still, still, still)
    window = SimpleNamespace(start_s=2.0, row_s=row_s, row=row, valid=np.ones((101, 19), bool))
    found = charts._rollout(cast(Any, window), residual)
    assert found is not None
    states, errors = found
    angle = np.rad2deg(np.linalg.norm(turn, axis=1))
    np.testing.assert_allclose(errors[:, 2], np.minimum(angle, 360.0 - angle), atol=0.2)
    turned = quat_to_rot(states.quat_wxyz)
    np.testing.assert_allclose(turned, rot_w @ exp_rot(turn), atol=0.004)
