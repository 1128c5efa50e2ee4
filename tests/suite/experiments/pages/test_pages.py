"""Pages from numbers made by hand: text, tables, goals, and loops in hidden worlds."""

import json
import re
from dataclasses import dataclass

import pytest

from eval.judging.statistics import Interval
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import (
    BEGIN,
    END,
    Made,
    Place,
    check_page,
    write_document,
)
from suite.experiments.pages.goals import goals
from suite.experiments.pages.hidden_vehicles import Came, named_grid, rows_of
from suite.experiments.pages.tables import points_cell
from suite.loop.hidden_effect import LABELS, NAMED
from tests.support.judged_cells import cell
from tests.support.loops import EFFECT, WON, four_trials
from tracks.common.grid import Cell, table

PNG = b"\x89PNG"


@dataclass(frozen=True)
class Config:
    """An experiment's options."""

    seed: int


def made(number="1"):
    picture = Picture(PNG, "A figure.")
    grid = table(["a", "b"], [[number, Cell("2", "good")]], note="Below.")
    return Made({"recipe": "quick"}, {"Part": [grid, picture, picture]}, {"x": 1})


def test_a_page_has_its_facts_its_tables_and_numbered_figures(tmp_path):
    place = Place(tmp_path / "docs", tmp_path)
    said = write_document(place, "seeds", Config(7), made(), Console())
    text = (tmp_path / "docs" / "seeds.md").read_text()
    assert text.startswith("# seeds\n\nThe policies of several training seeds")
    assert f"\n\n{BEGIN}\n\n- recipe: quick\n- command: `" in text and text.endswith(f"{END}\n")
    assert "## Part\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\nBelow." in text
    assert "![A figure.](seeds.png)" in text and "![A figure.](seeds-2.png)" in text
    numbers = json.loads((tmp_path / "docs" / "seeds.json").read_text())
    assert numbers["seed"] == numbers["config"]["seed"] == 7 and numbers["x"] == 1
    assert said["out"].endswith("seeds.md")


def test_a_page_made_again_keeps_the_text_around_what_is_made(tmp_path):
    place, page = Place(tmp_path, tmp_path), tmp_path / "seeds.md"
    write_document(place, "seeds", Config(7), made(), Console())
    page.write_text(page.read_text().replace("# seeds", "# My own title") + "\nWhat it means.\n")
    write_document(place, "seeds", Config(7), made("3"), Console())
    text = page.read_text()
    assert text.startswith("# My own title\n\nThe policies of")
    assert text.endswith(f"{END}\n\nWhat it means.\n")
    assert "| 3 | 2 |" in text and "| 1 | 2 |" not in text
    again = page.read_text()
    write_document(place, "seeds", Config(7), made("3"), Console())
    assert page.read_text() == again


@pytest.mark.parametrize(("lost", "words"), [(BEGIN, f"has no {BEGIN}"), (END, f"has no {END}")])
def test_a_page_whose_text_would_be_lost_is_refused(lost, words, tmp_path):
    page = tmp_path / "seeds.md"
    page.write_text(f"# Mine\n\n{BEGIN}\n{END}\n".replace(lost, ""))
    with pytest.raises(ValueError, match=re.escape(words)):
        check_page(tmp_path, "seeds")
    check_page(tmp_path, "table2")


def test_differences_are_coloured_by_what_they_tell():
    assert points_cell(Interval(0.1, 0.02, 0.2)) == Cell("+10 [+2, +20]", "good")
    assert points_cell(Interval(-0.1, -0.2, -0.02)).tone == "bad"
    assert points_cell(Interval(-0.001, -0.1, 0.1)) == Cell("+0 [-10, +10]", "")


def test_goals_by_hand():
    cells = [
        cell("zigzag", 0, 0.96, 7.3, low=0.902),  # others 10/10: the interval reaches down to 90 %
        cell("circular", 3, 0.93, 5.0, low=0.863),
        cell("zigzag", 9, 0.62, 6.1, low=0.52),  # others 7/10 at best: the rate itself
        cell("zigzag", 5, 0.1),  # no one printed a level 5
    ]
    zero, three, nine = goals(cells)
    assert (zero.success_miss, zero.v_max_miss) == (0, 0)
    assert zero.floor_miss == pytest.approx(0.03) and not zero.met
    assert three.success_miss == pytest.approx(0.037) and three.floor_miss == pytest.approx(0.05)
    assert (three.v_max, three.v_max_miss) == (6.2, pytest.approx(1.2))
    assert nine.success == 0.7 and nine.success_miss == pytest.approx(0.08)
    assert nine.v_max_miss == 0 and nine.floor_miss == pytest.approx(0.33)
    (perfect,) = goals([cell("ellipse", 6, 1.0, 6.4, low=0.963)])
    assert perfect.met


def test_a_printed_v_max_may_be_the_largest_of_ten():
    cells = [cell("ellipse", 6, 1.0, 6.2)._replace(v_max_of_ten=ten) for ten in (6.3, 6.2)]
    assert [goal.of_ten_miss for goal in goals(cells)] == [0, pytest.approx(0.1)]
    assert goals([cell("ellipse", 6, 1.0, 6.2)])[0].of_ten_miss is None, "too few trials"


def came(seed, won, named=True, world="a"):
    """Return a loop; one that names nothing has no fine-tuned policies."""
    names = LABELS if named else ("nominal", "before")
    found = {"effects": [EFFECT] if named else [], "verdict": "", "gap": {}}
    return Came(world, seed, {name: four_trials(won[name]) for name in names}, found, {})


def test_differences_are_in_pairs_and_count_no_loop_without_names():
    row, _ = rows_of(
        [came(0, WON), came(1, {**WON, NAMED: 2}), came(2, {**WON, "before": 0}, named=False)]
    )
    gap = row.gaps["named - control"]
    assert gap.of_seeds == [0.5, 0.0] and gap.difference.value == 0.25
    assert row.success["before"].value == 0.5 and row.loops == 3 and row.named == 2
    assert row.laps[NAMED] == (1.0, 6)
    assert row.laps["nominal"] == (1.0, 8)


def test_worlds_of_one_training_seed_add_no_trials():
    """They fly the same, and where nothing is hidden the same flights."""
    one, many = (
        rows_of([came(seed, WON, world=world) for seed in range(3) for world in worlds])[-1]
        for worlds in ("a", "ab")
    )
    assert many.loops == 6 and many.success == one.success
    assert many.gaps == one.gaps
    assert many.laps["nominal"] == (1.0, 24)


def test_a_gain_needs_three_seeds_that_agree_and_a_loop_with_names():
    def verdict(*loops):
        return {pair: gap.verdict for pair, gap in rows_of(loops)[0].gaps.items()}

    assert verdict(*(came(seed, WON) for seed in range(3)))["named - control"] == "gain"
    assert verdict(*(came(seed, WON) for seed in range(2)))["named - control"] == "unclear"
    worse = verdict(*(came(seed, {**WON, NAMED: 0}) for seed in range(3)))
    assert worse["named - control"] == "loss"
    assert verdict(came(0, WON, named=False)) == {}


def test_what_is_named_is_told_in_as_many_digits_as_mean_something():
    """Of a vector only what the flights can tell."""
    values = {"offset": {"value": [0.012001345, None], "ci95": None, "unit": "m"}}
    found = {
        "effects": [{"name": "com_offset", "alternatives": [], "parameters": values}],
        "verdict": "named",
        "gap": {"before": 7.123, "after": 1.0, "noise_floor": 1.0},
    }
    ((*_, named, told, gap),) = named_grid([Came("a", 0, {}, found, {})], {"a": "moved"}).rows
    assert named.text == "com_offset" and gap.text == "7.12, 1.00, 1.00"
    assert told.text == "com_offset offset x [m]: 0.012"
