"""Pictures show track, path, gates and end."""

from dataclasses import replace

import pytest

from eval.view import colours, picture
from eval.view.picture import write_grid, write_picture
from tests.support.flights import rollout, small_track
from tests.support.pixels import opened, share


def test_pictures_show_track_path_gates_and_end(tmp_path):
    track, flight, result = rollout()
    crash = rollout("collision", 1.5, False)
    write_picture(tmp_path / "bare.png", track)
    write_picture(tmp_path / "flown.png", track, flight, result)
    write_picture(tmp_path / "crash.png", *crash)
    bare, flown, hit = (opened(tmp_path / f"{n}.png") for n in ("bare", "flown", "crash"))
    assert share(bare, colours.AHEAD) > 1e-3 and share(bare, colours.PASSED) == 0
    assert share(flown, colours.PASSED) > 1e-3 and share(flown, colours.AHEAD, 2) < 2e-4
    assert share(hit, colours.CRASH, 4) > 1e-4 > share(flown, colours.CRASH, 4)
    assert share(hit, colours.AHEAD) > 1e-3 and share(hit, colours.PASSED) > 2e-4
    assert share(bare, colours.START) > 1e-4
    assert bare.size[0] > 600 and bare.size[1] > 250


def test_a_name_with_dollar_signs_is_a_name(tmp_path):
    track, flight, result = rollout()
    odd = (replace(track, family="a$x^{$"), flight, result._replace(policy="b$\\foo$"))
    write_picture(tmp_path / "one.png", *odd)
    write_grid(tmp_path / "grid.png", [odd])
    assert opened(tmp_path / "one.png").size[0] > 600


@pytest.mark.parametrize(("passed", "words"), [(0, "0 gates"), (1, "1 gate"), (2, "2 gates")])
def test_one_gate_is_one_gate(passed, words):
    _, _, result = rollout()
    said = picture._outcome(result._replace(gates_passed=passed), short=True)
    assert said.endswith(f", {words} passed")


def test_a_grid_has_a_panel_a_trial(tmp_path):
    trials = [rollout(), rollout("collision", 1.5, False), (small_track(6, seed=2), None, None)]
    write_grid(tmp_path / "one.png", trials[:1])
    write_grid(tmp_path / "three.png", trials, columns=2)
    one, three = opened(tmp_path / "one.png"), opened(tmp_path / "three.png")
    assert three.size[0] > 1.6 * one.size[0] and three.size[1] > 1.6 * one.size[1]
    with pytest.raises(ValueError, match="at least one trial"):
        write_grid(tmp_path / "none.png", [])
