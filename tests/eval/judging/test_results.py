"""Result files, the journal, tables of cells and pairs, and planned laps."""

import json
import math
import os
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eval.judging.plans import over_plan, plans
from eval.judging.results import Journal, read_trials, write_results
from eval.judging.statistics import wilson
from eval.judging.tables import NOTE, markdown_table, percent, summarise
from eval.worlds.trial import TrialSpec, track_of
from suite.common.errors import explain
from tests.support.judged_cells import ROWS, result
from tracks.geometry.crossing import crossing

COLUMNS = """track difficulty seed policy vehicle world success gates_passed ended_by collided_with
pos_x pos_y pos_z time_s v_max v_mean gates_8s gates_035""".split()


@pytest.mark.parametrize(
    ("successes", "trials", "text"),
    [(299, 300, "99.7 % [98, 100]"), (1, 300, "0.3 % [0, 2]"), (298, 300, "99 % [98, 100]"),
     (300, 300, "100 % [99, 100]"), (0, 300, "0 % [0, 1]"), (2999, 3000, "99.97 % [99.81, 99.99]"),
     (4990, 5000, "99.8 % [99.6, 99.9]"), (5, 5000, "0.1 % [0.0, 0.2]")],
)  # fmt: skip
def test_only_a_rate_without_a_failure_is_printed_as_100_percent(successes, trials, text):
    assert percent(wilson(successes, trials)) == text


def test_files(tmp_path):
    summary = summarise(ROWS)
    write_results(
        tmp_path / "out", ROWS, table_markdown=markdown_table(summary), summary=summary, seed=7
    )
    table = pq.read_table(tmp_path / "out" / "trials.parquet")
    assert table.column_names[: len(COLUMNS)] == COLUMNS
    header = json.loads(table.schema.metadata[b"suite"])
    assert header.keys() >= {"schema", "suite_version", "seed", "git_commit"}
    assert read_trials(tmp_path / "out" / "trials.parquet") == ROWS
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (written["schema"], written["seed"]) == (1, 7)
    (cell,) = written["cells"]
    assert (cell["trials"], cell["success"]["value"]) == (4, 0.75)
    assert cell["v_max"]["value"] == 6.5 and cell["lap_s"]["value"] == 11.5
    text = (tmp_path / "out" / "table.md").read_text()
    assert "75 % [30, 95]" in text and NOTE in text and "median" in NOTE and "schema: 1" in text
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == [
        "summary.json", "table.md", "trials.parquet",
    ]  # fmt: skip


def test_journal_resumes_after_a_kill(tmp_path):
    path, about = tmp_path / "journal.jsonl", {"policy": "ours", "vehicle": "reference"}
    with Journal(path, about) as journal:
        for row in ROWS[:3]:
            journal.append(row)
    whole = path.read_bytes()
    path.write_bytes(whole[:-17])  # killed while the last line was being written
    wanted = [row.trial for row in ROWS]
    with Journal(path, about) as journal:
        assert list(journal.done.values()) == ROWS[:2]
        assert journal.missing(wanted) == wanted[2:]
        for row in ROWS[2:]:
            journal.append(row)
    with Journal(path, about) as journal:
        assert list(journal.done.values()) == ROWS
    assert path.read_bytes().startswith(whole)
    path.write_text('{"about": {"pol')  # killed within the first line
    with Journal(path, about) as journal:
        assert not journal.done
        journal.append(ROWS[0])
    with Journal(path, about) as journal:
        assert list(journal.done) == [TrialSpec("zigzag", 3, 0)]


def test_journal_of_something_else_is_refused(tmp_path):
    path = tmp_path / "journal.jsonl"
    Journal(path, {"policy": "ours", "world": "mujoco"}).close()
    said = "otherwise (policy is 'ours' there, 'theirs' here; git_commit is None there, 'a' here); "
    with pytest.raises(ValueError, match=re.escape(said)):
        Journal(path, {"policy": "theirs", "world": "mujoco", "git_commit": "a"})
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(ValueError, match="line 2"):
        Journal(path, {"policy": "ours", "world": "mujoco"})
    for first in ("[]", '{"about": 3}'):
        path.write_text(first + "\n")
        with pytest.raises(ValueError, match="otherwise .*policy is None there, 'ours' here"):
            Journal(path, {"policy": "ours"})


@pytest.mark.parametrize(
    ("column", "cells", "said"),
    [
        ("seed", pa.array(["a", "b"]), "'seed' holds string"),
        ("success", pa.array([2.5, 3.5]), "'success' holds double"),
        ("gates_passed", pa.array([1, None]), "cells without a value"),
        ("policy", pa.array(["a", None]), "'policy' holds .* without a value"),
        ("policy", None, "no columns 'policy'"),
    ],
)
def test_trials_of_other_types_are_refused_by_column(tmp_path, column, cells, said):
    summary = summarise(ROWS[:2])
    write_results(tmp_path, ROWS[:2], table_markdown="", summary=summary, seed=7)
    path = tmp_path / "trials.parquet"
    table = pq.read_table(path).drop(column)
    pq.write_table(table if cells is None else table.append_column(column, cells), path)
    with pytest.raises(ValueError, match=f"trials.parquet: .*{said}") as met:
        read_trials(path)
    assert explain(met.value) is not None


def test_a_pipe_and_a_column_twice_are_no_trials(tmp_path):
    os.mkfifo(tmp_path / "pipe.parquet")
    with pytest.raises(ValueError, match="a named pipe"):
        read_trials(tmp_path / "pipe.parquet")
    write_results(tmp_path, ROWS, table_markdown="", summary=summarise(ROWS), seed=7)
    table = pq.read_table(tmp_path / "trials.parquet")
    pq.write_table(table.append_column("seed", table["seed"]), tmp_path / "trials.parquet")
    with pytest.raises(ValueError, match="2 columns 'seed'"):
        read_trials(tmp_path / "trials.parquet")


def test_paired_differences_are_on_the_same_trials():
    other = [result(seed, policy="theirs", speed=4.0) for seed in (3, 2, 1)]
    summary = summarise([*ROWS, *other, result(0, difficulty=9, policy="theirs")])
    assert [cell.policy for cell in summary["cells"]] == ["ours", "theirs", "theirs"]
    (pair,) = summary["paired"]
    assert (pair.policy, pair.against, pair.trials) == ("theirs", "ours", 3)
    assert pair.success.value == pytest.approx(1 / 3) and pair.p_value == 1.0
    assert pair.v_mean.value == -1.0 and np.isnan(pair.v_mean[1:]).all(), "three pairs are too few"
    text = markdown_table(summary)
    assert "| theirs - ours |" in text and "| +33.3 [" in text and "nan" not in text
    assert "| -1.00 |" in text


def test_cells_do_not_depend_on_what_else_is_in_the_table_and_count_late_answers():
    lost = result(5, False, difficulty=1)
    none, beside = summarise([lost, *ROWS])["cells"]
    assert beside == summarise(ROWS)["cells"][0]
    assert math.isnan(none.lap_s.value), "no trial of the other cell was finished"
    late = [result(seed, False)._replace(ended_by="timeout", late_actions=1) for seed in (7, 8)]
    summary = summarise([*ROWS, *late])
    (cell,) = summary["cells"]
    assert cell.late == 2 and cell.ended_by["timeout"] >= 2
    assert "of these 2 by a late or missing answer" in markdown_table(summary)


def test_every_plan_passes_the_gates_of_its_track_in_order():
    assert len(plans()) == 24
    for trial, plan in plans().items():
        track = track_of({}, trial)
        assert np.abs(plan.pos_w[0] - track.start_pos_w).max() < 1e-3
        assert plan.time_s[-1] == pytest.approx(plan.lap_s, abs=1e-3)
        when = []
        for center_w, rot_w, opening_g in zip(*track.scene.gates[:3], strict=True):
            passed, _ = crossing(center_w, rot_w, opening_g, plan.pos_w[:-1], plan.pos_w[1:])
            assert passed.any(), trial
            when.append(np.flatnonzero(passed)[0])
        assert when == sorted(when) and when[-1] == len(plan.pos_w) - 2, trial


def test_the_ratio_is_of_finished_trials_on_planned_tracks():
    rows = [result(0), result(1, False), result(2), result(0, policy="other", difficulty=4)]
    (found,) = over_plan(rows)
    lap_s = plans()[TrialSpec("zigzag", 3, 0)].lap_s
    assert (found.policy, found.finished, found.planned) == ("ours", 1, 2)
    assert found.ratio.value == pytest.approx(rows[0].time_s / lap_s)
    assert np.isnan(over_plan([result(1, False)])[0].ratio.value)
