"""Result files and the journal."""

import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from eval.judging.results import JOURNAL, Journal, read_trials, write_results
from eval.judging.tables import NOTE, markdown_table, summarise
from eval.worlds.trial import TrialResult, TrialSpec
from suite.common.errors import explain
from tests.support.judged_cells import ROWS

COLUMNS = """track difficulty seed policy vehicle world success gates_passed ended_by collided_with
pos_x pos_y pos_z time_s v_max v_mean gates_8s gates_035""".split()


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


def test_a_bad_file_is_named(tmp_path):
    path = tmp_path / "trials.parquet"
    path.write_bytes(b"PAR1 nothing")
    with pytest.raises(ValueError, match=r"trials\.parquet: not a readable"):
        read_trials(path)


def test_journal_resumes_after_a_kill(tmp_path):
    path, about = tmp_path / JOURNAL, {"policy": "ours", "vehicle": "reference"}
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


def test_journal_cut_within_its_first_line_starts_again(tmp_path):
    path = tmp_path / JOURNAL
    path.write_text('{"about": {"pol')
    with Journal(path, {"policy": "ours"}) as journal:
        assert not journal.done
        journal.append(ROWS[0])
    with Journal(path, {"policy": "ours"}) as journal:
        assert list(journal.done) == [TrialSpec("zigzag", 3, 0)]


def test_journal_of_something_else_is_refused(tmp_path):
    path = tmp_path / JOURNAL
    Journal(path, {"policy": "ours", "world": "mujoco"}).close()
    with pytest.raises(ValueError, match=r"otherwise \(another git_commit, another policy\); give"):
        Journal(path, {"policy": "theirs", "world": "mujoco", "git_commit": None})
    path.write_text(path.read_text() + "{}\n")
    with pytest.raises(ValueError, match="line 2"):
        Journal(path, {"policy": "ours", "world": "mujoco"})


@pytest.mark.parametrize(
    ("column", "cells", "said"),
    [
        ("seed", pa.array(["a", "b"]), "'seed' holds string"),
        ("success", pa.array([2.5, 3.5]), "'success' holds double"),
        ("time_s", pa.array([[1.0], [2.0]]), "'time_s' holds list"),
        ("gates_passed", pa.array([1, None]), "cells without a value"),
        ("policy", pa.array([b"\xff", b"a"]), "'policy' holds binary"),
        ("policy", None, "no column 'policy'"),
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


def test_a_pipe_or_too_many_rows_are_no_trials(tmp_path):
    os.mkfifo(tmp_path / "pipe.parquet")
    with pytest.raises(ValueError, match="a named pipe"):
        read_trials(tmp_path / "pipe.parquet")
    fields = {name: pa.array(np.zeros(2_000_000, np.int8)) for name in TrialResult._fields}
    pq.write_table(pa.table(fields), tmp_path / "many.parquet")
    with pytest.raises(ValueError, match="2,000,000 trials, allowed are up to 1,000,000"):
        read_trials(tmp_path / "many.parquet")
