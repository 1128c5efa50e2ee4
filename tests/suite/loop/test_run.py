"""suite loop: from training to the report, interrupted anywhere, refused where it does not fit.

The gradient step is a stand-in, since compiling the real one three times takes minutes and is
tested with the trainer; trials are cut short. All else is what a person runs.
"""

import json

import numpy as np
import pytest

from eval.judging.results import read_trials
from eval.logs.flight_log import read_flights
from policies.formats.checkpoint import WEIGHTS
from suite import cli
from suite.loop.compare import VARIANTS
from suite.loop.tables import CAVEAT
from tests.support.loops import Small

TUNED = ["--recipe", "quick", "--track", "zigzag", "--difficulty", "0", "--trials", "3"]
TUNED += ["--flights", "3", "--finetune-iterations", "2", "--fit-iterations", "3"]
TUNED += ["--seed", "4", "--set", "episode.batch=2"]
ARGS = [*TUNED, "--iterations", "3"]
STAGES = ["train", "eval-before", "flights", "delta", "tuned-without", "tuned-with"]
STAGES += ["eval-without", "eval-with", "replays"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Return a finished loop's folder and what it did."""
    out = tmp_path_factory.mktemp("loop") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        small = Small(patch)
        assert cli.main(["loop", *ARGS, "--out", str(out)]) == 0
    return out, small


def test_the_loop_leaves_tables_report_and_recording(whole):
    out, _ = whole
    for name in ("table.md", "loop.json", "report.html", "recording.rrd", "run.json"):
        assert (out / name).stat().st_size > 100, name
    for name in STAGES:
        assert (out / name / "stage.json").is_file(), name
    recording = (out / "recording.rrd").read_bytes()
    assert b"before, zigzag level 0 seed 4" in recording
    assert b"tuned with delta, zigzag level 0 seed 4" in recording
    found = json.loads((out / "loop.json").read_text())
    assert set(found) >= {"schema", "suite_version", "git_commit", "seed", "comparison", "delta"}
    assert [line["track"] for line in found["comparison"]] == ["zigzag", "all"]
    assert list(found["stage_seconds"]) == STAGES
    table = (out / "table.md").read_text()
    assert found["verdict"] in table and CAVEAT in table
    assert "point mass, lag, drag and delay fitted" in table
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "<script" not in page and "http" not in page
    assert all((out / line.split('"')[0]).is_file() for line in page.split('href="')[1:])


def test_recorded_flights_are_never_judged_and_all_policies_fly_the_same_trials(whole):
    out, _ = whole
    judged = [read_trials(out / f"eval-{name}" / "trials.parquet") for name in VARIANTS]
    assert [row.trial for row in judged[0]] == [("zigzag", 0, seed) for seed in (4, 5, 6)]
    assert all([r.trial for r in rows] == [r.trial for r in judged[0]] for rows in judged)
    logs, _ = read_flights(sorted((out / "flights").glob("*.parquet")))
    recorded = {log.about["seed"] for log in logs}
    assert recorded == {100_004, 100_005, 100_006}
    assert not recorded & {row.seed for row in judged[0]}


def test_the_control_costs_the_same_training_on_the_same_tracks(whole):
    _, small = whole
    first, control, corrected = small.trained[:3], small.trained[3:5], small.trained[5:]
    assert [with_delta for _, with_delta, _ in small.trained] == [False] * 5 + [True] * 2
    assert len(control) == len(corrected) == 2
    for one, two in zip(control, corrected, strict=True):
        assert one[0] == two[0]
        np.testing.assert_array_equal(one[2], two[2])
    assert not np.array_equal(first[0][2], control[0][2]), "fine-tuning sees new tracks"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["fly", "train"])
def test_a_loop_stopped_again_and_again_comes_to_the_same(
    whole, kind, tmp_path, monkeypatch, capfd
):
    out, _ = whole
    again = tmp_path / "again"
    small = Small(monkeypatch)
    # In the middle of each training, or of the recording, a judgement and the replays.
    stops = [2, 4, 6] if kind == "train" else [4, 8, 13]
    for number in stops:
        small.stop_after = (kind, number)
        assert cli.main(["loop", *ARGS, "--out", str(again)]) == 130
        assert not (again / "loop.json").exists()
    assert cli.main(["loop", *ARGS, "--out", str(again)]) == 0
    assert "done before" in capfd.readouterr().err
    for name in ("train", "tuned-without", "tuned-with"):
        one, two = (run / name / "policy" / WEIGHTS for run in (out, again))
        assert one.read_bytes() == two.read_bytes(), name
        one, two = (run / name / "metrics.jsonl" for run in (out, again))
        rows = [[json.loads(line) for line in path.read_text().splitlines()] for path in (one, two)]
        assert [r["iteration"] for r in rows[0]] == [r["iteration"] for r in rows[1]]
    for name in VARIANTS:
        one, two = (run / f"eval-{name}" / "trials.parquet" for run in (out, again))
        assert read_trials(one) == read_trials(two)
    assert (out / "table.md").read_text() == (again / "table.md").read_text()


def test_a_finished_loop_is_only_told_again(whole, monkeypatch, capfd):
    out, _ = whole
    small = Small(monkeypatch)
    before = (out / "table.md").read_text()
    assert cli.main(["loop", *ARGS, "--out", str(out), "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    assert not small.flown and not small.trained
    assert said["verdict"] in before and (out / "table.md").read_text() == before


def test_another_configuration_is_refused(whole, monkeypatch, capfd):
    out, _ = whole
    small = Small(monkeypatch)
    other = list(ARGS)
    other[other.index("--trials") + 1] = "5"
    assert cli.main(["loop", *other, "--out", str(out)]) == 2
    said = capfd.readouterr().err
    assert "trials is 3 there, 5 here" in said and "another --out" in said
    assert not small.flown and not small.trained


def test_a_loop_goes_on_where_its_folder_was_moved(whole, tmp_path, monkeypatch):
    """In the middle of judging, and of recording: what was flown counts."""
    given, small = whole[0] / "train" / "policy", Small(monkeypatch)
    args = ["loop", *TUNED, "--policy", str(given), "--out"]
    for place, flown in (("one", 1), ("two", 4), ("three", 6)):
        small.stop_after = ("fly", flown)
        assert cli.main([*args, str(tmp_path / place)]) == 130
        assert len(small.flown) == flown
        (tmp_path / place).rename(tmp_path / {"one": "two", "two": "three"}.get(place, "end"))
    assert len(set(small.flown)) == 6, "three judged, three recorded, none twice"
    end = tmp_path / "end"
    assert not small.trained and not (end / "train").exists(), "a given policy is not trained"
    assert (end / "given" / "policy" / WEIGHTS).read_bytes() == (given / WEIGHTS).read_bytes()
    one, two = (read_trials(run / "eval-before" / "trials.parquet") for run in (whole[0], end))
    flown = [[row._replace(policy="") for row in rows] for rows in (one, two)]
    assert flown[0] == flown[1], "as in the loop that trained it and was never stopped"
