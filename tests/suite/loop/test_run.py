"""suite loop: from training to the report, interrupted anywhere, refused where it does not fit.

The gradient step is a stand-in, since compiling the real one three times takes minutes and is
tested with the trainer; trials are cut short. All else is what a person runs.
"""

import json

import numpy as np
import pytest

from eval.judging.results import read_trials
from eval.judging.statistics import bootstrap_mean
from eval.logs.flight_log import read_flights
from eval.worlds.trial import TrialResult
from policies.formats.checkpoint import WEIGHTS
from suite import cli
from suite.common.errors import WorkFailed
from suite.common.report import markdown, rich_table
from suite.loop import run as loop_run
from suite.loop.compare import CAVEAT, Line, compare, grids, verdict
from suite.loop.config import resolve
from suite.loop.work import Quiet
from suite.train.presets import finetune, preset
from tests.support.loops import Small

ARGS = ["--preset", "small", "--track", "zigzag", "--difficulty", "0", "--trials", "3"]
ARGS += ["--flights", "3", "--iterations", "3", "--finetune-iterations", "2"]
ARGS += ["--fit-iterations", "3", "--seed", "4", "--set", "episode.batch=2"]
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


def test_the_report_needs_nothing_else(whole):
    page = (whole[0] / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 5
    assert "<script" not in page and "http" not in page
    for line in (whole[0] / "report.html").read_text().split('href="')[1:]:
        assert (whole[0] / line.split('"')[0]).is_file()


def test_recorded_flights_are_never_judged_and_all_policies_fly_the_same_trials(whole):
    out, _ = whole
    judged = [read_trials(out / f"eval-{name}" / "trials.parquet") for name in loop_run.VARIANTS]
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


@pytest.mark.parametrize("kind", ["train", "fly"])
def test_a_loop_stopped_again_and_again_comes_to_the_same(
    whole, kind, tmp_path, monkeypatch, capfd
):
    out, _ = whole
    again = tmp_path / "again"
    small = Small(monkeypatch)
    # In the middle of each training, or of each judgement, the recording and the replays.
    stops = [2, 4, 6] if kind == "train" else [1, 4, 8, 11, 13]
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
    for name in loop_run.VARIANTS:
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
    assert cli.main(["loop", *ARGS, "--trials", "5", "--out", str(out)]) == 2
    said = capfd.readouterr().err
    assert "trials is 3 there, 5 here" in said and "another --out" in said
    assert not small.flown and not small.trained


def test_a_given_policy_is_not_trained(whole, tmp_path, monkeypatch):
    given, out = whole[0] / "train" / "policy", tmp_path / "out"
    small = Small(monkeypatch)
    small.stop_after = ("fly", 1)
    assert cli.main(["loop", *ARGS, "--policy", str(given), "--out", str(out)]) == 130
    assert not small.trained and not (out / "train").exists()
    assert (out / "given" / "policy" / WEIGHTS).read_bytes() == (given / WEIGHTS).read_bytes()


def test_flights_that_cannot_be_fitted_end_the_loop_with_advice(whole, tmp_path, monkeypatch):
    def none(*args):
        raise ValueError("no window of 1.0 s in 3 flights")

    monkeypatch.setattr(loop_run, "fit_delta", none)
    stages = loop_run.Stages(tmp_path, Quiet(), 9)
    config = resolve(recipe="small", trials=3)
    with pytest.raises(WorkFailed, match="no window.*--iterations"):
        loop_run._fit(config, stages)
    assert not stages.is_done("delta")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--preset", "smal"], "Did you mean 'small'?"),
        (["--policy", "nobody.onnx"], "needs a checkpoint's folder"),
        (["--track", "my.toml"], "cannot be held apart"),
        (["--track", "zigzg"], "Did you mean 'zigzag'?"),
        (["--difficulty", "10"], "level 10 is not 0 to 9"),
        (["--vehicle", "referense"], "Did you mean 'reference'?"),
        (["--trials", "0"], "--trials is 0"),
        (["--trials", "100001"], "--trials is 100001; it must be 100000 or less"),
        (["--flights", "1", "--track", "zigzag", "--difficulty", "0"], "--flights is 1"),
        (["--iterations", "0"], "--iterations is 0"),
        (["--finetune-iterations", "0"], "--finetune-iterations is 0"),
        (["--fit-iterations", "0"], "--fit-iterations is 0"),
        (["--set", "loss.progres=1"], "Did you mean 'progress'?"),
    ],
)
def test_what_cannot_be_used_is_said_before_anything_is_written(args, words, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["loop", *args, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1
    assert not out.exists()


def test_fine_tuning_is_shorter_and_gentler():
    base = preset("racer")
    tuned = finetune(base, 0.1)
    assert tuned.optimizer.iterations == round(0.1 * base.optimizer.iterations)
    assert tuned.optimizer.rate < base.optimizer.rate
    assert tuned.seed != base.seed and tuned.physics == base.physics


def _result(seed, success, v_mean, gates=8, level=0):
    ended = "finished" if success else "collision"
    rest = dict.fromkeys(TrialResult._fields[-5:], 0)
    return TrialResult(
        "zigzag", level, seed, "p", "v", "w", success, gates, ended, None, 0.0, 0.0, 0.0,
        5.0, v_mean + 1, v_mean, **rest,
    )  # fmt: skip


def test_differences_are_of_the_same_trials():
    n = 40
    speed = np.linspace(2, 6, n)
    won = {"before": 10, "without": 20, "with": 30}
    results = {
        name: [
            _result(k, k < count, speed[k] + 0.5 * (name == "with"), 8 if k < count else 3, k % 2)
            for k in range(n)
        ]
        for name, count in won.items()
    }
    lines = compare(results)
    assert [(line.track, line.difficulty, line.trials) for line in lines] == [
        ("zigzag", 0, 20),
        ("zigzag", 1, 20),
        ("all", None, 40),
    ]
    overall = lines[-1]
    assert [m.value for m in overall.success] == pytest.approx([0.25, 0.5, 0.75, 0.25, 0.5])
    # 10 pairs, all one way: 2 / 2^10 by hand.
    assert overall.p_value == pytest.approx(2 / 2**10)
    assert overall.gates.with_minus_without.value == pytest.approx(5 * 0.25)
    # Every trial is 0.5 m/s faster: no spread in pairs, whatever the spread between trials.
    assert tuple(overall.v_mean.with_minus_without) == pytest.approx((0.5, 0.5, 0.5))
    assert tuple(overall.v_max.with_minus_before) == pytest.approx((0.5, 0.5, 0.5))
    assert overall.v_mean.before.high - overall.v_mean.before.low > 0.5
    success = grids(lines)[0]
    assert [cell.text for cell in success.rows[-1]][:4] == ["all", "all", "40", "25 [14, 40]"]
    assert success.rows[-1][6].tone == "good" and success.rows[-1][6].text.startswith("+25 [+")
    assert "75 % of 40 trials succeed: more than" in verdict(overall)
    with pytest.raises(ValueError, match="same trials"):
        compare({**results, "with": results["with"][::-1]})


def test_no_difference_is_called_none():
    rows = [_result(k, k < 5, 3.0) for k in range(10)]
    lines: list[Line] = compare({"before": rows, "without": rows, "with": rows})
    assert "not to be told from" in verdict(lines[-1])
    cell = grids(lines)[0].rows[-1][6]
    assert cell.tone == "" and cell.text.startswith("+0 [")
    speed = grids(lines)[2].rows[-1][6]
    assert speed.text == "+0.00 [+0.00, +0.00]"


def test_tables_read_alike_as_markdown_and_in_a_terminal():
    rows = [_result(k, k < 5, 3.0) for k in range(10)]
    grid = grids(compare({"before": rows, "without": rows, "with": rows}))[0]
    assert len(markdown(grid).splitlines()) == 2 + 2 + len(grid.rows)
    table = rich_table(grid)
    assert table.row_count == len(grid.rows) and len(table.columns) == len(grid.headers)


def test_bootstrap_of_a_mean_is_that_of_the_central_limit():
    values = np.random.default_rng(3).exponential(2.0, 400)
    found = bootstrap_mean(values)
    half = 1.96 * values.std() / np.sqrt(len(values))
    assert found.value == pytest.approx(values.mean())
    assert found.high - found.value == pytest.approx(half, rel=0.1)
    assert found.value - found.low == pytest.approx(half, rel=0.1)
    assert np.isnan(bootstrap_mean(np.array([]))).all()
