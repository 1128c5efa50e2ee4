"""A diagnosis as JSON, tables and charts, and the first screen of its report."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from suite.commands.diagnose import run as command
from suite.common.console import Console
from suite.common.report import html
from suite.diagnose import run
from suite.diagnose.config import Config
from suite.diagnose.diagnose import Verdict, diagnose
from suite.diagnose.estimate.parameters import Candidate, make_space
from suite.diagnose.evidence.view_means import centred
from suite.diagnose.identify.run import is_identified
from suite.diagnose.report import charts, sections, summary
from suite.diagnose.report import diagnosis_json as as_json
from suite.diagnose.report.charts import series_chart
from suite.diagnose.report.page import channels_grid, page
from suite.diagnose.search.evaluation import NamedEffect
from suite.diagnose.sources.source import FAR
from suite.diagnose.verdict.actuators import actuator_mismatches
from suite.diagnose.verdict.gap import Gap
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN, with_effects
from tracks.common.files import plain


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
    x, y, z = summary.components({"name": "com_offset", "parameters": {"offset": entry}})
    assert (x.label, x.texts()) == ("offset x [m]", ("0.01200", "0.01190 to 0.01210"))
    assert x.is_significant and not y.is_significant and not z.is_significant
    assert y.texts() == ("not different from 0", "-0.0010 to 0.0018")
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
    assert [(one.label, one.texts()[0]) for one in shown] == [
        ("scale 1 [1]", "0.9"),
        ("scale 3 [1]", "0.800"),
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
    table = channels_grid({horizon: {**groups, "velocity": none} for horizon, groups in every})
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


DRAG = {
    "name": "linear_drag",
    "alternatives": ["rotor_drag"],
    "parameters": {"coefficient": {"value": [0.31, 0.302, 0.01], "unit": "1/s",
                                   "ci95": [[0.3, 0.32], [0.29, 0.31], [-0.01, 0.03]]}},
    "size": {"force": 0.8, "torque": 0.0, "drift": 0.4},
    "view": "force",
    "gap_removed": 0.9,
}  # fmt: skip


def entries(verdict, effects=(), where=None, **more):
    base = {"verdict": verdict, "effects": list(effects), "reference": [], "negligible": []}
    base |= {"unexplained": {"where": where, "above_noise": []}, "identified": False}
    advice = ["linear_drag from rotor_drag: bob up and down on a circle"]
    base["separate_with"] = advice if effects else []
    base["gap"] = {"before": 17.3, "after": 4.78, "offset": {}}
    return {**base, **more}


@pytest.mark.parametrize(
    ("gap", "text"),
    [(41_400.0, "41,400"), (328.4, "328"), (1.03, "1.03"), (1e-10, "less than 0.001")],
)
def test_a_gap_is_printed_without_powers_of_ten(gap, text):
    assert summary.figure(gap) == text


def test_an_answer_has_the_effect_its_values_and_its_size_or_what_is_too_small():
    assert summary.answer(entries("named", [DRAG])) == (
        "Wrong or missing in the vehicle file: Drag proportional to the airspeed (linear_drag or "
        "rotor_drag): coefficient x 0.31 1/s, coefficient y 0.302 1/s. On these flights it causes "
        "0.8 m/s² and 0.4 m after one second (RMS). This explains the gap between simulation and "
        "flights."
    )
    arm = {**DRAG, "name": "lever_arm", "alternatives": [], "parameters": {}, "size": None}
    both = summary.answer(entries("named", [arm, DRAG]))
    assert both.index("in the vehicle file: Drag") < both.index(". Wrong in the logs: Position")
    by_force = {**DRAG, "size": {**DRAG["size"], "drift": None}}
    partly = summary.answer(entries("partly", [by_force]))
    assert "causes 0.8 m/s² (RMS). This explains a part" in partly
    changed = summary.answer(entries("named", [DRAG], reference=["a"]))
    assert "has changed since the reference" in changed
    left_out = [("torque_trim", False), ("inertia_scale", True)]
    small = entries("no_gap", negligible=[{"name": n, "relevant": is_so} for n, is_so in left_out])
    assert summary.answer(small).endswith(
        "Significant but too small to matter: torque_trim. "
        "Perhaps only an error of the model, or cancelled by another effect: inertia_scale."
    )


def measured(verdict, after, effects=(), reason=None, floor=0.15, offset=7.9, **more):
    gap = {"of": "error of the torque", "unit": "rad/s^2", "before": 17.3, "after": after}
    offsets = {"before": 9.0, "after": offset, "unit": "rad/s^2"}
    gap |= {"noise_floor": floor, "offset": {"torque": offsets}}
    rest = [{"reason": reason}] if reason else []
    more |= {"relevance": {"torque": 0.5}, "unexplained": {"where": None, "above_noise": rest}}
    return summary.headline(entries(verdict, effects, gap=gap, **more))


def test_a_headline_states_the_floor_the_errors_that_remain_and_offsets_that_do_not_count():
    text = measured("named", 4.78, [DRAG], "that logged signals hardly predict")
    assert text.endswith(
        "This explains the gap between simulation and flights, except for an error that logged "
        "signals hardly predict. On held-out flights the error of the torque falls from 17.3 to "
        "4.78 rad/s² (noise floor 0.15). A constant offset of each flight remains, which does not "
        "count as a gap: 7.9 rad/s² (torque)."
    )
    # An offset below the threshold of relevance does not matter.
    assert "offset" not in measured("named", 0.16, [DRAG], offset=0.4)
    none = measured("no_gap", 17.3, (), "that is too small to matter", offset=0.4)
    assert none == (
        "Simulation and flights agree, except for an error that is too small to matter. On "
        "held-out flights the error of the torque is 17.3 rad/s² (noise floor 0.15)."
    )
    assert "within the measurement noise." in measured("no_gap", 17.3)
    assert "error" not in summary.answer(entries("no_gap", reference=["a"]))
    # The unit of rollouts is the noise floor.
    assert "floor" not in measured("unknown", 17.3, floor=1.0)


def test_simulated_flights_that_stay_far_are_no_part_of_what_agrees():
    text = measured("no_gap", 17.3, (), "that logged signals hardly predict", warnings=[FAR])
    assert text.startswith(
        "The forces and torques that were compared agree, except for an error that logged signals "
        "hardly predict. But simulated flights of 1 s stay far from the measured ones."
    )
    named = measured("named", 4.78, [DRAG], warnings=[FAR])
    assert "between simulation and flights. But simulated flights of 1 s stay far" in named


def test_an_effect_that_lowers_the_offsets_alone_explains_no_gap():
    agree, differ = (measured(verdict, 17.3, [DRAG]) for verdict in ("named", "partly"))
    offset = "(RMS). This explains a constant offset of the flights. Simulation and flights"
    assert f"{offset} agree within" in agree and f"{offset} differ, and no effect" in differ
    # A random wind explains an error that no simulation lowers, and offsets may not fall either.
    for effects, left in (([{**DRAG, "gap_removed": None}], 7.9), ([DRAG], 9.0)):
        assert "explains the gap" in measured("named", 17.3, effects, offset=left)


def test_a_drag_of_the_file_that_the_flights_do_not_show_is_not_said_to_be_missing():
    interval = [[0.0, 0.01]] * 3
    none = {"coefficient": {"value": [0.0, 1e-17, 0.004], "unit": "1/s", "ci95": interval}}
    answer = summary.answer(entries("named", [{**DRAG, "parameters": none}]))
    assert (
        "(linear_drag or rotor_drag): coefficient x not different from 0, coefficient y" in answer
    )


def test_a_rotor_lag_alone_explains_no_gap_of_force_and_torque():
    lag = {**DRAG, "name": "motor_lag", "parameters": {}, "size": None, "view": "commands"}
    lag["alternatives"] = []
    agree, differ = (measured(verdict, 17.3, [lag]) for verdict in ("named", "partly"))
    rotors = "This explains how measured and commanded rotor speeds differ. "
    assert f"{rotors}Simulation and flights agree within the measurement noise." in agree
    assert f"{rotors}Simulation and flights differ, and no effect of the" in differ
    assert "explains the gap" in measured("named", 4.78, [lag, DRAG])
    far = measured("named", 17.3, [lag], warnings=[FAR])
    assert "compared agree within" in far and "stay far" in far and "Simulation and" not in far
    same = entries("partly", [lag], gap={"before": 17.3, "after": 17.3})
    assert summary.next_steps(same)[0].endswith(" Its values are approximate.")


@pytest.mark.parametrize(
    ("verdict", "words"),
    [
        ("named", ["vehicle.toml", "do not separate linear_drag, rotor_drag", "expect no_gap"]),
        ("partly", ["approximate", "do not separate", "suite check", "Remaining error"]),
        ("unknown", ["suite check", "suite identify", "Remaining error", "suite delta"]),
    ],
)
def test_every_verdict_says_what_to_do_next(verdict, words):
    effects = [] if verdict == "unknown" else [DRAG]
    steps = summary.next_steps(entries(verdict, effects, where="a swing at 1 Hz"))
    assert all(word in step for word, step in zip(words, steps, strict=True))
    assert " ".join(steps).count("bob up and down") == len(effects)


def test_a_file_of_suite_identify_is_not_sent_back_to_it(tmp_path):
    path, written = tmp_path / "mine.toml", "# From racer5 by suite identify, 2 flights (motors)\n"
    path.write_text(written + 'name = "mine"\n')
    assert is_identified(str(path)) and not is_identified("racer5")
    path.write_text('name = "by suite identify"\n')
    assert not is_identified(str(path))
    steps = summary.next_steps(entries("unknown", identified=True))
    assert "repeat it if the vehicle has changed" in steps[1]


@pytest.mark.slow
def test_flights_that_no_rollout_comes_near_do_not_agree():
    log = fly(PLAIN, 0, duration_s=4.0, noise=0.1)
    log = replace(log, rate_cmd_b=log.rate_cmd_b + [20.0, 0.0, 0.0])
    found = as_json.diagnosis_json(diagnose([log], PLAIN))
    assert found["verdict"] == "no_gap" and FAR in found["warnings"]
    assert "stay far from the measured ones" in found["headline"]
    assert "as it is" not in " ".join(summary.next_steps(found))


def test_errors_of_the_logs_alone_send_nobody_to_the_trainer():
    arm = {**DRAG, "name": "lever_arm", "alternatives": []}
    (first, last) = summary.next_steps(entries("named", [arm]))
    assert "to suite diagnose" in first and "train" not in first and "no_gap" in last
    assert "eval, train" in summary.next_steps(entries("named", [arm, DRAG]))[0]


@pytest.mark.parametrize("verdict", ["no_gap", "named", "partly"])
def test_after_a_search_for_a_change_the_file_itself_counts_as_untested(verdict):
    steps = summary.next_steps(entries(verdict, [DRAG], reference=["old"]))
    assert "was not tested: for that, leave out --reference" in steps[0]
    assert "as it is" not in steps[0]
