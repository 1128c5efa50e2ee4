"""Pages from numbers made by hand: text, tables and goals."""

import json
import re
from dataclasses import dataclass

import pytest

from eval.judging.statistics import Interval
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments.pages.document import BEGIN, END, Made, check_page, write_document
from suite.experiments.pages.paper import goals
from suite.experiments.study.cache import Place
from suite.loop.compare import difference_cell
from tests.support.judged_cells import cell
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
    said = write_document(place, "schemes", Config(7), made(), Console())
    text = (tmp_path / "docs" / "schemes.md").read_text()
    assert text.startswith("# schemes\n\nPPO, our method, and it without the field")
    assert f"\n\n{BEGIN}\n\n- recipe: quick\n- command: `" in text and text.endswith(f"{END}\n")
    assert "## Part\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\nBelow." in text
    assert "![A figure.](schemes.png)" in text and "![A figure.](schemes-2.png)" in text
    numbers = json.loads((tmp_path / "docs" / "schemes.json").read_text())
    assert numbers["seed"] == numbers["config"]["seed"] == 7 and numbers["x"] == 1
    assert said["out"].endswith("schemes.md")


def test_a_page_made_again_keeps_the_text_around_what_is_made(tmp_path):
    place, page = Place(tmp_path, tmp_path), tmp_path / "schemes.md"
    write_document(place, "schemes", Config(7), made(), Console())
    page.write_text(page.read_text().replace("# schemes", "# My own title") + "\nWhat it means.\n")
    write_document(place, "schemes", Config(7), made("3"), Console())
    text = page.read_text()
    assert text.startswith("# My own title\n\nPPO, our method")
    assert text.endswith(f"{END}\n\nWhat it means.\n")
    assert "| 3 | 2 |" in text and "| 1 | 2 |" not in text
    again = page.read_text()
    write_document(place, "schemes", Config(7), made("3"), Console())
    assert page.read_text() == again


@pytest.mark.parametrize(("lost", "words"), [(BEGIN, f"has no {BEGIN}"), (END, f"has no {END}")])
def test_a_page_whose_text_would_be_lost_is_refused(lost, words, tmp_path):
    page = tmp_path / "schemes.md"
    page.write_text(f"# Mine\n\n{BEGIN}\n{END}\n".replace(lost, ""))
    with pytest.raises(ValueError, match=re.escape(words)):
        check_page(tmp_path, "schemes")
    check_page(tmp_path, "table2")


def test_differences_are_coloured_by_what_they_tell():
    assert difference_cell(Interval(0.1, 0.02, 0.2)) == Cell("+10 [+2, +20]", "good")
    assert difference_cell(Interval(-0.1, -0.2, -0.02)).tone == "bad"
    assert difference_cell(Interval(-0.001, -0.1, 0.1)) == Cell("+0 [-10, +10]", "")


def test_goals_by_hand():
    cells = [
        cell("zigzag", 0, 0.96, 7.3, low=0.902),  # others 10/10: the interval reaches down to 90 %
        cell("circular", 3, 0.93, 5.0, low=0.863),
        cell("zigzag", 9, 0.62, 6.1, low=0.52),  # others 7/10 at best: the rate itself
        cell("zigzag", 5, 0.1),  # no one printed a level 5
    ]
    zero, three, nine = goals(cells)
    assert (zero.success_miss, zero.v_max_miss) == (0, 0)
    assert zero.floor_miss == pytest.approx(0.03)
    assert three.success_miss == pytest.approx(0.037) and three.floor_miss == pytest.approx(0.05)
    assert (three.v_max, three.v_max_miss) == (6.2, pytest.approx(1.2))
    assert nine.success == 0.7 and nine.success_miss == pytest.approx(0.08)
    assert nine.v_max_miss == 0 and nine.floor_miss == pytest.approx(0.33)
    (perfect,) = goals([cell("ellipse", 6, 1.0, 6.4, low=0.963)])
    assert not (perfect.success_miss or perfect.floor_miss or perfect.v_max_miss)


def test_a_printed_v_max_may_be_the_largest_of_ten():
    cells = [cell("ellipse", 6, 1.0, 6.2)._replace(v_max_of_ten=ten) for ten in (6.3, 6.2)]
    assert [goal.of_ten_miss for goal in goals(cells)] == [0, pytest.approx(0.1)]
    assert goals([cell("ellipse", 6, 1.0, 6.2)])[0].of_ten_miss is None, "too few trials"
