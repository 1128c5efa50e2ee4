"""A partial log is told by what it has what can be asked of it."""

import numpy as np

from eval.importers.findings import asked_of


def test_motor_commands_and_positions_tell_weight_and_balance():
    rows = {"pos": np.zeros((3, 3)), "pwm": np.zeros((3, 4))}
    text = asked_of(rows, ["quat", "rate"]).text
    assert "no attitude and no body rates" in text
    assert "balance of the rotors in hover" in text
    assert "its torque" not in text


def test_a_path_alone_tells_nothing_more():
    text = asked_of({"pos": np.zeros((3, 3))}, ["quat", "rate", "command"]).text
    assert text.endswith("nothing but its path")
