"""Policies under conditions, and training seeds of one recipe."""

import numpy as np
import pytest

from suite.common.curve import append
from suite.experiments.seeds import repeats
from tests.support.documents import page, reproduce
from tests.support.judged_cells import cell


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


def test_the_median_policy_and_the_repeats():
    rates = {"a": (0.9, 0.7), "b": (1.0, 1.0), "c": (0.2, 0.4), "d": (0.9, 0.8)}
    cells = {n: [cell("zigzag", k, r) for k, r in enumerate(of)] for n, of in rates.items()}
    found = repeats({name: cells[name] for name in "abc"})
    assert found.median == "a" and found.mean_success["c"] == pytest.approx(0.3)
    assert found.mean == pytest.approx(0.7)
    assert found.standard_deviation == pytest.approx(np.std([0.8, 1.0, 0.3], ddof=1))
    assert repeats(cells).median == "a", "of an even number the lower of the middle two"
    assert np.isnan(repeats({"a": cells["a"]}).standard_deviation)


def test_seeds_are_trained_once_and_compared(sky, made, tmp_path):
    recipe = ["--preset", "small", "--iterations", "3", "--set", "episode.batch=2"]
    args = [*recipe, "--training-seeds", "0", "4", "--trials", "1"]
    assert reproduce(tmp_path, "seeds", *args) == 0
    assert [(c.seed, c.optimizer.iterations, c.episode.batch) for c in made] == [
        (0, 3, 2),
        (4, 3, 2),
    ]
    assert reproduce(tmp_path, "seeds", *args) == 0
    assert len(made) == 2 and len(sky.flown) == 24
    text, numbers = page(tmp_path, "seeds")
    assert set(numbers["spread"]["mean_success"]) == {"seed 0", "seed 4"}
    assert "- recipe: small episode.batch=2\n" in text
    digest = next((tmp_path / "cache" / "trainings").glob("*/policy"))
    rows = [{"iteration": k, "seconds": 45.2, "cold": k == 0} for k in range(3)]
    append(digest.parent, rows)
    assert reproduce(tmp_path, "seeds", *args) == 0
    assert "trained at commit unknown in 1 min 30 s" in page(tmp_path, "seeds")[0]
