"""One table, three looks."""

import io

from rich.console import Console

from tracks.common.grid import Cell, html_table, markdown, rich_table, table

GRID = table(
    ["name", "v [m/s]"], [["a|b", Cell("<3>", "bad")], ["all", "5 [4, 6]"]], "Title", "Below."
)


def test_markdown():
    assert markdown(GRID) == (
        "Title\n\n| name | v [m/s] |\n| --- | --- |\n"
        "| a\\|b | <3> |\n| all | 5 [4, 6] |\n\nBelow.\n"
    )


def test_a_terminal_shows_brackets_and_notes_as_they_are():
    file = io.StringIO()
    screen = Console(width=80, file=file)
    screen.print(rich_table(GRID))
    said = file.getvalue()
    assert all(text in said for text in ("Title", "v [m/s]", "<3>", "5 [4, 6]", "Below."))


def test_html_is_escaped_and_sums_up_where_it_is_told_to():
    page = html_table(GRID)
    assert "<caption>Title</caption>" in page and '<td class="bad">&lt;3&gt;</td>' in page
    assert 'class="sum"' not in page and '<p class="note">Below.</p>' in page
    summed = html_table(GRID.__class__("", GRID.headers, GRID.rows, strong_last=True))
    assert '<tr class="sum"><td>all</td>' in summed and summed.count("sum") == 1
