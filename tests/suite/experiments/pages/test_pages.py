"""A page's text, its tables and its charts, from numbers made by hand."""

import json
from dataclasses import dataclass

from eval.judging.statistics import Interval
from suite.common.console import Console
from suite.common.report import Picture, Report, Section
from suite.experiments.pages import charts
from suite.experiments.pages.document import Place, write_document
from suite.experiments.pages.tables import every_training, points_cell
from suite.experiments.study.intervals import Gap
from suite.experiments.study.training import Trained
from tests.support.judged_cells import cell
from tracks.common.grid import Cell, Grid, table
from tracks.families import JUDGED

PNG = b"\x89PNG"


@dataclass(frozen=True)
class Config:
    """An experiment's options."""

    seed: int


def test_a_page_has_its_facts_its_tables_and_numbered_figures(tmp_path):
    picture = Picture(PNG, "A figure.")
    parts = [table(["a", "b"], [["1", Cell("2", "good")]], note="Below."), picture, picture]
    report = Report("Title", "What came out.", {"recipe": "small"}, [Section("Part", parts)])
    place = Place(tmp_path / "docs", tmp_path)
    said = write_document(place, "name", Config(7), report, {"x": 1}, Console())
    text = (tmp_path / "docs" / "name.md").read_text()
    assert text.startswith("# Title\n\nWhat came out.\n\n- recipe: small\n- command: `")
    assert "| a | b |\n| --- | --- |\n| 1 | 2 |\n\nBelow." in text
    assert "![A figure.](name.png)" in text and "![A figure.](name-2.png)" in text
    numbers = json.loads((tmp_path / "docs" / "name.json").read_text())
    assert numbers["seed"] == numbers["config"]["seed"] == 7 and numbers["x"] == 1
    assert said["out"].endswith("name.md")


def test_how_many_trainings_share_the_cores_is_told(tmp_path):
    def told(workers):
        return Place(tmp_path, tmp_path, workers).at_once

    assert told(None) == told(1) == "1, on all cores"
    assert told(2) == "2, each on its own share of the cores"
    assert told("tcp://host:8786") == "as many as the cluster has workers"


def test_differences_are_coloured_by_what_they_tell():
    assert points_cell(Interval(0.1, 0.02, 0.2)) == Cell("+10 [+2, +20]", "good")
    assert points_cell(Interval(-0.1, -0.2, -0.02)).tone == "bad"
    assert points_cell(Interval(-0.001, -0.1, 0.1)) == Cell("+0 [-10, +10]", "")


def test_every_training_has_a_line_and_one_that_diverged_no_numbers():
    runs = [
        Trained("a", 0, "", 1.0, 0.0, "c", "", [{"gates": 0.0}, {"gates": 1.234}]),
        Trained("a", 1, "", 1.0, 0.0, "c", "it diverged", []),
    ]
    (grid,) = every_training("row", runs, {"gates": 2}, lambda run: f"{run.seconds:g} s").parts
    assert isinstance(grid, Grid)
    lines = [[entry.text for entry in row] for row in grid.rows]
    assert lines == [["a", "0", "1.23", "1 s"], ["a", "1", "diverged", "1 s"]]


def test_charts_are_pictures():
    cells = [cell(track, level, 0.5) for track in JUDGED for level in (0, 3)]
    gap = Gap(Interval(0.1, 0.0, 0.2), [0.1, 0.2])
    for made in (
        charts.level_chart(cells),
        charts.cells_chart({"p": cells}),
        charts.cells_chart({"p$x^{$": cells}),
        charts.gaps_chart({"a": gap}),
    ):
        assert made.startswith(PNG)
