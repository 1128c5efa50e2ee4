"""A page's text, its tables and its charts, from numbers made by hand."""

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
from suite.experiments.pages.tables import points_cell
from tracks.common.grid import Cell, table

PNG = b"\x89PNG"


@dataclass(frozen=True)
class Config:
    """An experiment's options."""

    seed: int


def made(number="1"):
    picture = Picture(PNG, "A figure.")
    grid = table(["a", "b"], [[number, Cell("2", "good")]], note="Below.")
    return Made({"recipe": "small"}, {"Part": [grid, picture, picture]}, {"x": 1})


def test_a_page_has_its_facts_its_tables_and_numbered_figures(tmp_path):
    place = Place(tmp_path / "docs", tmp_path)
    said = write_document(place, "seeds", Config(7), made(), Console())
    text = (tmp_path / "docs" / "seeds.md").read_text()
    assert text.startswith("# seeds\n\nThe policies of several training seeds")
    assert f"\n\n{BEGIN}\n\n- recipe: small\n- command: `" in text and text.endswith(f"{END}\n")
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
