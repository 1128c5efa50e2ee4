"""Figures in README, docs/results.md and the pages of results are those of the JSON files."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[4]
RESULTS = ROOT / "docs" / "results"
NUMBERS = {path.stem: json.loads(path.read_text("utf-8")) for path in RESULTS.glob("*.json")}
LEVELS = (0, 3, 6, 9)


def percent(share, digits=0):
    return f"{100 * share:.{digits}f}"


def success(found):
    value, low, high = (percent(found[key]) for key in ("value", "low", "high"))
    return f"{value} % [{low}, {high}]"


def readme(page):
    """Return README's rows that lead to a page of results."""
    rows = (ROOT / "README.md").read_text("utf-8").splitlines()
    return "\n".join(row for row in rows if row.startswith("|") and f"results/{page}.md" in row)


def cells_of(track):
    every = {(c["track"], c["difficulty"]): c for c in NUMBERS["table2"]["cells"]}
    return [every[track, level] for level in LEVELS]


def rows_of(page, key, *names):
    found = {row[key]: row for row in NUMBERS[page]["rows"]}
    return [found[name] for name in names]


@pytest.mark.parametrize("track", ["zigzag", "circular", "ellipse"])
def test_the_papers_table(track):
    rates, speeds = (
        "/".join(form(cell[key]["value"]) for cell in cells_of(track))
        for key, form in (("success", percent), ("v_max", "{:.1f}".format))
    )
    (row,) = [row for row in readme("table2").splitlines() if row.startswith(f"| {track}")]
    assert f"{rates} %, {speeds} m/s" in row, row
    parts = (f"{success(c['success'])}, {c['v_max']['value']:.1f} m/s" for c in cells_of(track))
    wanted = f"| {track} | {' | '.join(parts)} |"
    assert wanted in (ROOT / "docs" / "results.md").read_text("utf-8"), wanted


def test_the_field_and_other_ways_to_learn():
    text = (ROOT / "docs" / "results.md").read_text("utf-8")
    shares = (row["over"]["success_cross"]["mean"]
              for row in rows_of("ablation", "setting", "field 0.4", "progress 0.4"))  # fmt: skip
    assert "| the paper's | {} % | {} % |".format(*map(percent, shares)) in text
    ours, ppo = (row["curves"]["gates"][-1]["mean"]
                 for row in rows_of("schemes", "scheme", "ours", "ppo"))  # fmt: skip
    assert f"| ours, with the field | {ours:.2f} |" in text
    assert f"| PPO, for which this budget is small | {ppo:.2f} |" in text


def intervals(value):
    """Yield every success with its interval."""
    if isinstance(value, dict):
        if isinstance(value.get("success"), dict) and {"value", "low"} <= set(value["success"]):
            yield success(value["success"])
        for entry in value.values():
            yield from intervals(entry)
    elif isinstance(value, list):
        for entry in value:
            yield from intervals(entry)


@pytest.mark.parametrize("page", ["table2"])
def test_a_page_has_the_successes_of_its_numbers(page):
    text = (RESULTS / f"{page}.md").read_text("utf-8")
    wanted = set(intervals(NUMBERS[page]))
    assert wanted and not [one for one in wanted if one not in text]


@pytest.mark.parametrize("page", sorted(NUMBERS))
def test_a_page_is_of_the_run_that_its_numbers_are_of(page):
    text = (RESULTS / f"{page}.md").read_text("utf-8")
    for name, said in NUMBERS[page]["made_by"].items():
        assert f"- {name}: {said}" in text, name
    assert re.search(r"`suite reproduce " + page, NUMBERS[page]["made_by"]["command"])
