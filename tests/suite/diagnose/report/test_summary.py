"""The first screen of a report: one answer and the next steps for each verdict."""

import pytest

from suite.diagnose.identify.run import is_identified
from suite.diagnose.report.summary import answer, next_steps

DRAG = {
    "name": "linear_drag",
    "alternatives": ["rotor_drag"],
    "parameters": {"coefficient": {"value": [0.31, 0.302, 0.01], "unit": "1/s",
                                   "ci95": [[0.3, 0.32], [0.29, 0.31], [-0.01, 0.03]]}},
    "size": {"force": 0.8, "torque": 0.0, "drift": 0.4},
}  # fmt: skip


def found(verdict, effects=(), where=None, **more):
    base = {"verdict": verdict, "effects": list(effects), "reference": [], "negligible": []}
    base |= {"unexplained": {"where": where}, "not_examined": [], "identified": False}
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
    small = found("no_gap", negligible=[{"name": "torque_trim"}], not_examined=["torque"])
    assert answer(small).endswith("Significant but too small to matter: torque_trim.")
    assert any("These logs do not show: torque." in step for step in next_steps(small))
    assert not any("do not show" in step for step in next_steps(found("no_gap")))


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
