"""Pages: their text and numbers, the published ones, and what suite reproduce refuses."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from eval.judging.statistics import Interval, wilson
from policies import shipped
from suite import cli
from suite.cli import parse
from suite.commands import reproduce as command
from suite.common.console import Console
from suite.common.report import Picture
from suite.experiments import EXPERIMENTS, published
from suite.experiments.pages import charts
from suite.experiments.pages.document import BEGIN, END, PageContents, check_page, write_document
from suite.experiments.pages.paper import ablation, goals
from suite.experiments.study.cache import Workspace, page_code
from suite.experiments.study.training import Spread
from suite.judging.content import policy_digest
from suite.loop.compare import difference_cell
from tests.support import commands
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
    return PageContents({"recipe": "quick"}, {"Part": [grid, picture, picture]}, {"x": 1})


def test_a_page_has_its_facts_tables_and_figures_and_keeps_other_text(tmp_path):
    place = Workspace(tmp_path / "docs", tmp_path)
    said = write_document(place, "schemes", Config(7), made(), ["suite"], Console())
    text = (tmp_path / "docs" / "schemes.md").read_text()
    assert text.startswith("# schemes\n\nPPO, our method, and our method without the field")
    assert f"\n\n{BEGIN}\n\n- recipe: quick\n- command: `" in text and text.endswith(f"{END}\n")
    assert "## Part\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n\nBelow." in text
    assert "![A figure.](schemes.png)" in text and "![A figure.](schemes-2.png)" in text
    numbers = json.loads((tmp_path / "docs" / "schemes.json").read_text())
    assert numbers["seed"] == numbers["config"]["seed"] == 7 and numbers["x"] == 1
    assert said["out"].endswith("schemes.md")
    # Made again, it keeps the text around what is made.
    page = tmp_path / "docs" / "schemes.md"
    page.write_text(page.read_text().replace("# schemes", "# My own title") + "\nWhat it means.\n")
    write_document(place, "schemes", Config(7), made("3"), ["suite"], Console())
    text = page.read_text()
    assert text.startswith("# My own title\n\nPPO, our method")
    assert text.endswith(f"{END}\n\nWhat it means.\n")
    assert "| 3 | 2 |" in text and "| 1 | 2 |" not in text
    write_document(place, "schemes", Config(7), made("3"), ["suite"], Console())
    assert page.read_text() == text


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
    assert difference_cell(Interval(0.004, 0.001, 0.009)) == Cell("+0.4 [+0.1, +0.9]", "good")
    assert difference_cell(Interval(0.04, 0.002, 0.08)).text == "+4.0 [+0.2, +8.0]"
    assert difference_cell(Interval(-0.001, -0.1, 0.1)) == Cell("+0 [-10, +10]", "")


def test_the_chart_of_the_ablation_explains_its_diamonds_whichever_rows_the_paper_has(monkeypatch):
    monkeypatch.setattr(charts, "png", lambda figure: figure)
    numbers = {name: Spread(0.5, 0.4, 0.6) for name in ("success_cross", "collision_free", "v_max")}
    rows, kinds = {"field 0.8": numbers, "progress 0.8": numbers}, {"field": "f", "progress": "p"}
    assert [key in ablation()[1] for key in rows] == [False, True]
    figure = charts.bars_chart(rows, ablation()[1], kinds, "3 seeds")
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["mean, least and most of 3 seeds", "the paper"]


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
    # A printed v_max may be the largest of ten.
    cells = [cell("ellipse", 6, 1.0, 6.2)._replace(v_max_of_ten=ten) for ten in (6.3, 6.2)]
    assert [goal.of_ten_miss for goal in goals(cells)] == [0, pytest.approx(0.1)]
    assert goals([cell("ellipse", 6, 1.0, 6.2)])[0].of_ten_miss is None, "too few trials"


ROOT = Path(__file__).resolve().parents[3]
RESULTS = ROOT / "docs" / "results"
NUMBERS = {path.stem: json.loads(path.read_text("utf-8")) for path in RESULTS.glob("*.json")}


def percent(share):
    return f"{100 * share:.0f}"


def success(found):
    value, low, high = (percent(found[key]) for key in ("value", "low", "high"))
    return f"{value} % [{low}, {high}]"


def readme(page):
    """Return README's rows that lead to a page of results."""
    rows = (ROOT / "README.md").read_text("utf-8").splitlines()
    return "\n".join(row for row in rows if row.startswith("|") and f"results/{page}.md" in row)


def rows_of(page, key, *names):
    found = {row[key]: row for row in NUMBERS[page]["rows"]}
    return [found[name] for name in names]


@pytest.mark.parametrize("track", ["zigzag", "circular", "ellipse"])
def test_the_papers_table(track):
    every = {(c["track"], c["difficulty"]): c for c in NUMBERS["table2"]["cells"]}
    cells = [every[track, level] for level in (0, 3, 6, 9)]
    rates = "/".join(percent(cell["success"]["value"]) for cell in cells)
    speeds = "/".join(f"{cell['v_max']['value']:.1f}" for cell in cells)
    (row,) = [row for row in readme("table2").splitlines() if row.startswith(f"| {track}")]
    assert f"{rates} %, {speeds} m/s" in row, row
    parts = (f"{success(c['success'])}, {c['v_max']['value']:.1f} m/s" for c in cells)
    wanted = f"| {track} | {' | '.join(parts)} |"
    assert wanted in (ROOT / "docs" / "results.md").read_text("utf-8"), wanted


FORMS = ("field", "progress")
"""Settings of the ablation with the loss L_p, with the field and without it."""


def spread(found):
    """Return mean, least and most as per cent."""
    return {key: percent(found[key]) for key in ("mean", "least", "most")}


def test_the_field_helps_at_every_weight_of_progress():
    text, page = (
        " ".join((ROOT / "docs" / name).read_text("utf-8").split())
        for name in ("results.md", "results/ablation.md")
    )
    field, without = (
        [row["over"]["success_cross"] for row in rows_of("ablation", "setting", *names)]
        for names in ([f"{kind} {w}" for w in (0.4, 0.8, 1.2, 1.6, 3.2)] for kind in FORMS)
    )
    pairs = zip(field, without, strict=True)
    assert all(one["least"] > other["most"] for one, other in pairs)
    shares = [[percent(one["mean"]) for one in rows] for rows in (field, without)]
    first = [row[0] for row in shares]
    assert "| the paper's | 200 | {} % | {} % |".format(*first) in text
    said = "(0.4), {} % of the test flights pass all gates with the field, and {} % without it"
    assert said.format(*first) in page
    ranges = " | ".join(f"{row[1]} to {row[-1]} %" for row in shares)
    assert f"| two to eight times that | 200 | {ranges} |" in text
    best = ("{mean} % ({least} to {most}".format(**spread(rows[-1])) for rows in (field, without))
    said = "with it reaches {} over three seeds), the best one without it {})."
    assert said.format(*best) in page


def test_the_complete_recipe_and_other_ways_to_learn():
    text = (ROOT / "docs" / "results.md").read_text("utf-8")
    (race,) = rows_of("four_gates", "policy", "race")
    passed = f"all four gates in {300 * race['success_cross']:.0f} of 300 trials"
    assert f"{passed}, with a v_max of {race['v_max']:.1f} m/s" in " ".join(text.split())
    passed = f"{300 * race['success_cross']:.0f} of 300"
    assert f"| {passed}, {race['v_max']:.1f} m/s (paper: 95 %, 6.5 m/s) |" in readme("four_gates")
    starts = ("| ours, with the field |", "| ours, with L_proj ", "| PPO ")
    rows = rows_of("schemes", "scheme", "ours", "projection", "ppo")
    page = (ROOT / "docs" / "results" / "schemes.md").read_text("utf-8")
    for start, row in zip(starts, rows, strict=True):
        wanted = "| {mean:.2f} ({least:.2f} to {most:.2f}) |".format(**row["curves"]["gates"][-1])
        (line,) = [line for line in text.splitlines() if line.startswith(start)]
        assert line.endswith(wanted), line
        share, v_max = (row["curves"][name][-1]["mean"] for name in ("success_cross", "v_max"))
        assert f"million {wanted} {percent(share)} % | {v_max:.1f} m/s | " in page


DISTURBANCES = {
    "command delay": ("latency", 80, 120),
    "motor lag": ("motor lag", 50, 80),
    "drag": ("drag", 8, 16),
    "error of the gates' positions (standard deviation on each axis)": (
        "gate-pose error",
        0.1,
        0.3,
    ),
    "delay of state and image": ("age of both", 80, 100),
    "lost images": ("lost images", 50, 80),
}
"""Row of the results -> section of the page `robustness`, and the sizes of both columns."""


def test_the_larger_disturbances_are_those_of_their_page():
    page = (RESULTS / "robustness.md").read_text("utf-8")
    results = (ROOT / "docs" / "results.md").read_text("utf-8")
    for row, (section, *sizes) in DISTURBANCES.items():
        (line,) = [line for line in results.splitlines() if line.startswith(f"| {row} |")]
        made = page.split(f"\n{section}\n")[1].split("\n\n")[0]
        for said, size in zip(line.strip("| ").split(" | ")[1:], sizes, strict=True):
            (rate,) = re.findall(rf"^\| {size} \| (\d+ %)", made, re.MULTILINE)
            assert said.startswith(f"{rate} "), (row, size, said)


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


@pytest.mark.parametrize("page", sorted(NUMBERS))
def test_a_page_is_of_its_numbers(page):
    text = (RESULTS / f"{page}.md").read_text("utf-8")
    for name, said in NUMBERS[page]["made_by"].items():
        assert f"- {name}: {said}" in text, name
    assert f"`suite reproduce {page}" in NUMBERS[page]["made_by"]["command"]
    if page == "table2":
        wanted = set(intervals(NUMBERS[page]))
        assert wanted and not [one for one in wanted if one not in text]


def test_the_counts_of_blind_cases_are_the_sums_of_their_sets():
    text = (RESULTS / "blind.md").read_text("utf-8")
    lines = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    rows = [[cell.strip() for cell in line] for line in lines]
    sets = [row for row in rows if len(row) == 9 and " of " in row[3]]
    totals = [row[1:5] for row in rows if len(row) == 6 and " of " in row[1]]
    assert sets and len(totals) == 6
    for column, cells in enumerate(totals, 3):
        pairs = {name: np.zeros(2, int) for name in ("continuous", "MuJoCo", "RotorPy")}
        for row in sets:
            pairs[row[0]] += [int(number) for number in (row[column] or "0 of 0").split(" of ")]
        sums = [f"{a} of {b}" if b else "" for a, b in pairs.values()]
        count, trials = (int(number) for number in sum(pairs.values()))
        interval = wilson(count, trials)
        ends = f" ({percent(interval.low)}-{percent(interval.high)} %)"
        # The last row counts intervals, which are not independent.
        counted = f"{count} of {trials}{'' if cells == totals[-1] else ends}"
        assert cells == [*sums, counted]
    false, no_gap, single, *_ = totals
    named, wrong = single[3].split(" (")[0], false[3].split(" (")[0]
    assert f"| {named} cases; {wrong}, three" in readme("blind")
    results = (ROOT / "docs" / "results.md").read_text("utf-8")
    for cells in totals:
        row = " | ".join(cell or "not tested" for cell in cells[:3])
        assert (f"| {row} |" in results) == (cells != no_gap), row


def write_page(folder, name, flown, code):
    made_by = {"ours": f"{flown[0]}, SHA-256 {flown[1][:16]}", "vehicle": "reference"}
    page = {"git_commit": "f8502435b6b42b44", "made_by": made_by, "code_sha256": code}
    (folder / f"{name}.json").write_text(json.dumps(page))


def test_a_page_is_older_than_another_policy_or_other_code(tmp_path, capsys):
    code, current = page_code("table2"), policy_digest(shipped.DEFAULT)
    write_page(tmp_path, "table2", (shipped.DEFAULT, current), code)
    write_page(tmp_path, "simulators", (shipped.DEFAULT, "0" * 16), code)
    # A checkpoint in a folder with the name of a shipped policy is another policy.
    write_page(tmp_path, "robustness", (f"runs/{shipped.DEFAULT}", "0" * 16), "another")
    write_page(tmp_path, "faults", (shipped.DEFAULT, current), code)
    write_page(tmp_path, "schemes", (shipped.DEFAULT, current), page_code("schemes"))
    _, config = parse("reproduce", ["status", "--out", str(tmp_path)])
    pages = command.run(config, Console())["pages"]
    assert pages["table2"] == {"commit": "f8502435b6b42b44", "newer": []}
    assert pages["simulators"]["newer"] == ["policy"]
    assert pages["robustness"]["newer"] == pages["faults"]["newer"] == ["code"]
    assert pages["schemes"]["newer"] == []
    assert pages["ablation"]["newer"] is None
    assert "not made" in capsys.readouterr().out
    assert not config.written() and parse("reproduce", ["table2"])[1].written()
    for damaged in ("{", "[]", "{}"):
        (tmp_path / "table2.json").write_text(damaged)
        with pytest.raises(ValueError, match="table2.json: not the numbers of a page"):
            command.run(config, Console())


def test_all_makes_every_page_by_the_command_of_the_published_one(tmp_path, monkeypatch):
    asked, said = [], []
    monkeypatch.setattr(
        command, "_make_page", lambda config, words, _: asked.append(config) or said.append(words)
    )
    monkeypatch.setattr("sys.argv", ["suite", "reproduce", "all", "--out", str(tmp_path)])
    _, config = parse("reproduce", ["all", "--out", str(tmp_path)])
    assert list(command.run(config, Console())["seconds"]) == list(published.PUBLISHED)
    assert [type(c.experiment).__module__.rpartition(".")[2] for c in asked] == list(
        published.PUBLISHED
    )
    assert said[0] == ["suite", "reproduce", "table2", "--seed", "9600000", "--out", str(tmp_path)]
    assert set(published.PUBLISHED) <= set(EXPERIMENTS)
    assert all(replace(c, experiment=None) == replace(config, experiment=None) for c in asked)
    compared = []
    for name, options in published.PUBLISHED.items():
        if not (page := RESULTS / f"{name}.json").is_file():
            continue
        command_line = json.loads(page.read_text())["made_by"]["command"].strip("`")
        assert command_line.startswith(f"suite reproduce {name} "), name
        given = re.sub(r"--(out|workers|policy) \S+", "", command_line).split()[3:]
        assert sorted(given) == sorted(options.split()), name
        compared.append(name)
    assert len(compared) >= 6


def test_every_experiment_is_listed_and_has_help_for_every_option(capsys):
    assert cli.main(["reproduce"]) == 0
    listed = capsys.readouterr().out
    for name in EXPERIMENTS:
        assert cli.main(["reproduce", name, "--help"]) == 0
        said = capsys.readouterr().out
        assert name in listed and f"suite reproduce {name} [-h]" in said and "--json" in said
        assert "--cache" in said.partition("advanced options")[2]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("table3", "unknown"),
        ("table2 --policy race-papr", "Did you mean 'race-paper'?"),
        ("table2 --policy nowhere/policy", "nowhere/policy: no such file"),
        ("simulators --policy {folder}/mine.pt2", "suite reproduce never does"),
        ("simulators --simulator mujoco", "mujoco: the page compares the others"),
        ("simulators --simulator mjx --simulator mjx", "--simulator mjx is given twice"),
        ("robustness --only linear_darg", "Did you mean 'linear_drag'?"),
        ("robustness --policy race --policy race", "--policy race is given twice"),
        ("perception --only stero", "Did you mean 'stereo'?"),
        ("ablation --seed 0", "--seed 0 is one of --training-seeds"),
        ("ablation --only field@0.41", "Did you mean 'field 0.4'?"),
        ("ablation --set episode.batch=9", "this command sets episode.batch; give --worlds"),
        ("ablation --set seed=9", "this command sets seed; give --training-seeds"),
        ("ablation --set loss.jerk=1 loss.jerk=2", "'loss.jerk=2': loss.jerk is given twice"),
        ("ablation --set loss.field_gain=0", "loss.field_gain is 0, allowed is a number above"),
        ("ablation --worlds 5", "episode.batch is 5, allowed are multiples of episode.shards (2)"),
        ("ablation --recipe race-small", "--recipe race-small has 3 phases, allowed is a recipe"),
        ("ablation --workers 99", "--workers is 99"),
        ("schemes --training-seeds 1 1", "--training-seeds is 1 1"),
        ("schemes --worlds 5 --set episode.shards=1", "PPO are multiples of its 2 minibatches"),
        ("schemes --set loss.progress=1.2", "this command sets loss.progress; give --progress"),
        ("faults --workers 10.0.0.1:8786", "--workers is tcp://10.0.0.1:8786; allowed"),
        ("gpu", "JAX finds no GPU here"),
        ("gpu --worlds 4 8 --train-worlds 6", "allowed are those of --worlds: 4 8"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_done(
    line, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr("suite.train.run.train", None)
    monkeypatch.setattr("suite.experiments.study.judging.fly_share", None)
    program, place = tmp_path / "mine.pt2", tmp_path / "place"
    program.touch()
    place.mkdir()
    args = [word.replace("@", " ").format(folder=tmp_path) for word in line.split()]
    out = ("--out", place / "docs", "--cache", place / "cache")
    assert words in commands.refused(capsys, "reproduce", *args, *out)
    assert not list(place.iterdir())
