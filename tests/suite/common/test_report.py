"""A report as one HTML file, and its tables for terminals and Markdown."""

import base64
import io

from rich.console import Console

from suite.common.report import (
    Cell,
    Details,
    Grid,
    Links,
    Picture,
    Report,
    Section,
    markdown,
    ranged,
    rich_table,
    write_report,
)

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


def test_a_table_as_markdown():
    assert markdown(GRID) == (
        "Speeds\n\n| who | m/s |\n| --- | --- |\n| a\\|b | 3.1 |\n| <all> | 2.0 |\n\n"
        "Higher is better.\n"
    )


def test_a_table_for_a_terminal_shows_brackets_as_they_are():
    file = io.StringIO()
    grid = Grid("t", ["speed [m/s]"], [[Cell("[bold]", "bad")]])
    Console(file=file, width=60).print(rich_table(grid))
    assert "speed [m/s]" in file.getvalue() and "[bold]" in file.getvalue()


def test_a_mean_with_its_least_and_most():
    assert ranged(2.0, 1.25, 3.0, 1) == "2.0 [1.2, 3.0]"
