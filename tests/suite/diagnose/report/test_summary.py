"""The first screen of a report: one answer and the next steps for each verdict."""

import pytest

from suite.diagnose.identify.run import is_identified
from suite.diagnose.report.summary import answer, headline, next_steps

DRAG = {
    "name": "linear_drag",
    "alternatives": ["rotor_drag"],
    "parameters": {"coefficient": {"value": [0.31, 0.302, 0.01], "unit": "1/s",
                                   "ci95": [[0.3, 0.32], [0.29, 0.31], [-0.01, 0.03]]}},
    "size": {"force": 0.8, "torque": 0.0, "drift": 0.4},
}  # fmt: skip


def found(verdict, effects=(), where=None, **more):
    base = {"verdict": verdict, "effects": list(effects), "reference": [], "negligible": []}
    base |= {"unexplained": {"where": where, "above_noise": []}, "identified": False}
    advice = ["linear_drag from rotor_drag: bob up and down on a circle"]
    base["separate_with"] = advice if effects else []
    return {**base, **more}


def test_an_answer_has_the_effect_its_values_and_its_size_or_what_is_too_small():
    assert answer(found("named", [DRAG])) == (
        "Wrong or missing in the vehicle file: Drag proportional to the airspeed (linear_drag or "
        "rotor_drag): coefficient x 0.31 1/s, coefficient y 0.302 1/s. On these flights it causes "
        "0.8 m/s² and 0.4 m after one second (RMS). This explains the gap between simulation and "
        "flights."
    )
    by_force = {**DRAG, "size": {**DRAG["size"], "drift": None}}
    partly = answer(found("partly", [by_force]))
    assert "causes 0.8 m/s² (RMS). This explains a part" in partly
    assert "has changed since the reference" in answer(found("named", [DRAG], reference=["a"]))
    small = found("no_gap", negligible=[{"name": "torque_trim"}])
    assert answer(small).endswith("Significant but too small to matter: torque_trim.")


def measured(verdict, after, effects=(), reason=None, floor=0.15, offset=7.9, **more):
    gap = {"of": "error of the torque", "unit": "rad/s^2", "before": 17.3, "after": after}
    gap |= {"noise_floor": floor, "offset": {"torque": {"after": offset, "unit": "rad/s^2"}}}
    rest = [{"reason": reason}] if reason else []
    more |= {"relevance": {"torque": 0.5}, "unexplained": {"where": None, "above_noise": rest}}
    return headline(found(verdict, effects, gap=gap, **more))


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
    assert "error" not in answer(found("no_gap", reference=["a"]))
    # The unit of rollouts is the noise floor.
    assert "floor" not in measured("unknown", 17.3, floor=1.0)


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
    steps = next_steps(found(verdict, effects, where="a swing at 1 Hz"))
    assert all(word in step for word, step in zip(words, steps, strict=True))
    assert " ".join(steps).count("bob up and down") == len(effects)


def test_a_file_of_suite_identify_is_not_sent_back_to_it(tmp_path):
    path, written = tmp_path / "mine.toml", "# From racer5 by suite identify, 2 flights (motors)\n"
    path.write_text(written + 'name = "mine"\n')
    assert is_identified(str(path)) and not is_identified("racer5")
    path.write_text('name = "by suite identify"\n')
    assert not is_identified(str(path))
    steps = next_steps(found("unknown", identified=True))
    assert "repeat it if the vehicle has changed" in steps[1]


@pytest.mark.parametrize("verdict", ["no_gap", "named", "partly"])
def test_after_a_search_for_a_change_the_file_itself_counts_as_untested(verdict):
    steps = next_steps(found(verdict, [DRAG], reference=["old"]))
    assert "was not tested: for that, leave out --reference" in steps[0]
    assert "as it is" not in steps[0]
