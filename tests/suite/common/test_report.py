"""A report as one HTML file, and what people write for levels and tracks."""

import base64
import struct

import pytest
from matplotlib.figure import Figure

from suite.common.charts import DPI, png
from suite.common.report import Details, Links, Picture, Report, Section, write_report
from suite.judging.trials import parse_levels, parse_tracks
from tracks.common.grid import Cell, Grid

GRID = Grid(
    "Speeds",
    ["who", "m/s"],
    [[Cell("a|b"), Cell("3.1", "good")], [Cell("<all>"), Cell("2.0", "bad")]],
    strong_last=True,
    note="Higher is better.",
)


def test_a_page_holds_everything_and_escapes_what_is_text(tmp_path):
    parts = [
        "x < y", GRID, Picture(b"a png", "a picture"), Links([("a.md", "more")]),
        Details("log", "1 & 2"),
    ]  # fmt: skip
    report = Report("A & B", "It flew.", {"seed": "3"}, [Section("Part", parts)])
    page = write_report(tmp_path / "report.html", report).read_text()
    assert "<title>A &amp; B</title>" in page and "<p>x &lt; y</p>" in page
    assert "<dt>seed</dt><dd>3</dd>" in page and "<h2>Part</h2>" in page
    assert '<td class="good">3.1</td>' in page and '<tr class="sum"><td>&lt;all&gt;</td>' in page
    assert "data:image/png;base64," + base64.b64encode(b"a png").decode() in page
    assert '<a href="a.md">' in page and "<pre>1 &amp; 2</pre>" in page
    assert "<script" not in page and "http" not in page


def test_a_figure_is_a_png_file_of_its_size():
    file = png(Figure(figsize=(2.0, 1.0)))
    assert file.startswith(b"\x89PNG")
    assert struct.unpack(">II", file[16:24]) == (2 * DPI, DPI)


def test_levels_and_tracks():
    for text, levels in (
        ("3", [3]), ("0,3, 9", [0, 3, 9]), ("7-9,0,8", [7, 8, 9, 0]), ("all", list(range(10))),
    ):  # fmt: skip
        assert parse_levels(text) == levels
    for text in ("10", "-1", "3-1", "", "easy", "1,,2", "0-10"):
        with pytest.raises(ValueError, match="--difficulty"):
            parse_levels(text)
    assert parse_tracks("all") == ["zigzag", "circular", "ellipse"]
    assert parse_tracks("ellipse,my/course.toml") == ["ellipse", "my/course.toml"]
    assert parse_tracks("a.toml,k/../a.toml, zigzag,zigzag") == ["a.toml", "zigzag"]
    with pytest.raises(ValueError, match="Did you mean 'zigzag'"):
        parse_tracks("ellipse,zigzg")
