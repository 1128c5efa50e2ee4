"""The paper's table at a small size: from one command, resumed, and from the cache."""

import json

from policies import shipped
from tests.support.documents import another_racer, page, reproduce


def test_table2_and_all_levels(sky, tmp_path, capfd):
    sky.stop_after = 11
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7") == 130
    assert not (tmp_path / "docs").exists() and len(sky.flown) == 11
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7") == 0
    assert "11 of 30 trials were flown before" in capfd.readouterr().err
    assert len(sky.flown) == len(set(trial for *_, trial in sky.flown)) == 30
    text, numbers = page(tmp_path, "table2")
    assert {(cell["track"], cell["difficulty"]) for cell in numbers["cells"]} == {
        (track, level) for track in ("zigzag", "circular", "ellipse") for level in range(10)
    }
    # In a second nobody finishes: every cell misses what is asked of it, and says by how much.
    assert all(goal["success_miss"] > 0 for goal in numbers["goals"]["ours"])
    assert "| 90.0 points | 97 % | 97.0 points |" in text
    assert "| paper, with Delta Action Model | 9 | 7/10 | 6.1 |" in text
    assert "seeds: 7 to 7, 1 trials a cell" in text
    # Other documents find the flights of this one.
    asked = ("--policies", shipped.DEFAULT, "--trials", "1", "--seed", "7")
    assert reproduce(tmp_path, "seeds", *asked) == 0
    assert len(sky.flown) == 30
    text, numbers = page(tmp_path, "seeds")
    assert numbers["spread"]["median"] == shipped.DEFAULT
    # A second time nothing is flown and the same is written.
    capfd.readouterr()
    assert reproduce(tmp_path, "table2", "--trials", "1", "--seed", "7", "--json") == 0
    said = json.loads(capfd.readouterr().out)
    assert said["out"].endswith("table2.md") and len(said["cells"]) == 30
    assert len(sky.flown) == 30


def test_table2_with_policies_tuned_under_the_delta_model(sky, tmp_path):
    tuned = tmp_path / "tuned"
    another_racer(tuned, 1001)
    args = ["--trials", "1", "--delta-policy", str(tuned)]
    assert reproduce(tmp_path, "table2", *args) == 0
    assert len(sky.flown) == 30 + 12, "the paper's four levels"
    text, numbers = page(tmp_path, "table2")
    assert {cell["policy"] for cell in numbers["cells"]} == {
        "ours",
        "ours, with Delta Action Model",
    }
    assert "Goals by cell: ours, with Delta Action Model" in text
    assert not numbers["with_against_without"], "without its control nobody knows its merit"
    another_racer(tuned, 1002)
    args = [*args, "--control-policy", "racer"]
    assert reproduce(tmp_path, "table2", *args) == 0
    text, numbers = page(tmp_path, "table2")
    overall = numbers["with_against_without"][-1]
    assert overall["track"] == "all" and overall["trials"] == 12
    assert "With the Delta Action Model" in text and "with - without" in text
