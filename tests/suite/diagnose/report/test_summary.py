"""A diagnosis in words: the answer, its sizes, and what to do next."""

from dataclasses import replace

import pytest

from suite.diagnose.diagnose import diagnose
from suite.diagnose.identify.run import is_identified
from suite.diagnose.report import diagnosis_json as as_json
from suite.diagnose.report import summary
from suite.diagnose.sources.source import FAR
from tests.support.diagnosis_flights import fly
from tests.support.vehicles import PLAIN

DRAG = {
    "name": "linear_drag",
    "alternatives": ["rotor_drag"],
    "parameters": {"coefficient": {"value": [0.31, 0.302, 0.01], "unit": "1/s",
                                   "ci95": [[0.3, 0.32], [0.29, 0.31], [-0.01, 0.03]],
                                   "file": [0.0, 0.0, 0.0]}},
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
    [(41_400.0, "41,400"), (999.7, "1,000"), (328.4, "328"), (1.03, "1.03"),
     (1e-10, "less than 0.001")],
)  # fmt: skip
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


@pytest.mark.parametrize(
    ("force", "torque", "least", "words"),
    [
        (0.03, 1.14, 0.5, " These flights would not show a constant torque below 1.1 rad/s^2."),
        (
            0.2,
            1.14,
            0.5,
            "show a constant force below 0.2 m/s^2 or a constant torque below 1.1 rad",
        ),
        (0.03, 0.4, 0.5, ""),
        (0.03, 0.4, 0.0, ""),
    ],
)
def test_an_answer_without_a_gap_says_which_relevant_push_the_flights_would_not_show(
    force, torque, least, words
):
    relevance = {"force": 0.05, "torque": least, "drift": 0.025}
    more = {"visible": {"force": force, "torque": torque}, "relevance": relevance}
    found = entries("no_gap", **more)
    said, steps = summary.answer(found), " ".join(summary.next_steps(found))
    assert (words in said) if words else ("not show" not in said and "To see" not in steps)
    assert ("To see a smaller force or torque, log every" in steps) == (force > 0.05)
    by_all = " ".join(summary.next_steps({**found, "driven_by": "commands"}))
    assert ("To see a smaller force or torque, fly longer" in by_all) == (force > 0.05)
    assert "not show" not in summary.answer(entries("unknown", **more))


def test_a_large_effect_has_its_size_without_powers_of_ten():
    large = {**DRAG, "size": {"force": 0.0, "torque": 123.4, "drift": 99.7}}
    assert "causes 123 rad/s² and 100 m after one second" in summary.answer(
        entries("named", [large])
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


def test_an_answer_has_the_values_that_differ_from_the_vehicle_file_and_those_of_the_file():
    interval = [[0.0, 0.01], [0.0, 0.01], [0.17, 0.19]]
    drag = {
        "value": [0.0, 0.004, 0.18],
        "unit": "1/s",
        "ci95": interval,
        "file": [0.2, 0.005, 0.18],
    }
    answer = summary.answer(entries("named", [{**DRAG, "parameters": {"coefficient": drag}}]))
    assert "rotor_drag): coefficient x 0 1/s (vehicle file: 0.2). On these flights" in answer
    # All values are listed if only together they differ from the file.
    drag["file"] = [0.0, 0.005, 0.18]
    answer = summary.answer(entries("named", [{**DRAG, "parameters": {"coefficient": drag}}]))
    assert "coefficient x 0.0000 (not different from 0), coefficient y 0.0040 (not diff" in answer


def test_an_answer_says_where_a_weak_rotor_is():
    index = {"value": [1, 3], "unit": "1", "ci95": None, "place": ["front right", "rear left"]}
    scale = {"value": [0.7, 0.8], "unit": "1", "ci95": None, "file": [1.0, 1.0]}
    weak = {**DRAG, "name": "weak_motor", "alternatives": [], "size": None}
    weak["parameters"] = {"index": index, "scale": scale}
    assert summary.answer(entries("named", [weak])).startswith(
        "Wrong or missing in the vehicle file: One or several rotors give less thrust and torque "
        "than nominal (weak_motor): scale 1 0.7 (vehicle file: 1), scale 3 0.8 (vehicle file: 1). "
        "Rotor 1 is front right, 3 is rear left."
    )


def test_the_headline_has_no_more_digits_than_the_interval_supports():
    ci95 = [[0.38, 0.59], [0.41746, 0.41748], [1200.0, 1270.0]]
    wide = {"value": [0.4878, 0.41747, 1234.4], "unit": "1/s", "ci95": ci95}
    answer = summary.answer(entries("named", [{**DRAG, "parameters": {"coefficient": wide}}]))
    assert "coefficient x 0.49 1/s, coefficient y 0.417 1/s, coefficient z 1234 1/s" in answer


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
