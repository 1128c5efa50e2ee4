"""Policies under conditions at a small size: every condition once, and two on the same trials."""

from tests.support.documents import page, reproduce


def test_robustness(sky, tmp_path, capfd):
    only = ["--only", "wind", "mass_offset", "gate-pose error"]
    args = [*only, "--trials", "1", "--difficulty", "0", "--policy", "racer"]
    sky.stop_after = 5
    assert reproduce(tmp_path, "robustness", *args) == 130
    assert reproduce(tmp_path, "robustness", *args) == 0
    # Undisturbed once for all, two signs of mass, four winds, four gate errors; three tracks.
    assert len(sky.flown) == 3 * (1 + 2 + 4 + 4)
    winds = {flight[1].effects["constant_wind"].velocity for flight in sky.flown
             if "constant_wind" in flight[1].effects}  # fmt: skip
    assert sorted(round(y / 0.8) for _, y, _ in winds) == [2, 4, 6, 8]
    assert {flight[2].gate_m for flight in sky.flown} == {0, 0.05, 0.1, 0.2, 0.3}
    text, numbers = page(tmp_path, "robustness")
    assert len(numbers["conditions"]) == 1 + 2 + 5 + 5
    assert text.count("| 0 % [0, 56] |") == 13
    assert (tmp_path / "docs" / "robustness-2.png").is_file()
