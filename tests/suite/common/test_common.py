"""What commands share: reports, curves, messages, stages and records of a run, processes."""

import base64
import errno
import json
import multiprocessing
import os
import re
import struct
import sys
import traceback
import types
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from suite.common import curve
from suite.common.charts import DPI, png
from suite.common.console import Console, duration, size
from suite.common.errors import FAILED, UNUSABLE, WorkFailed, explain
from suite.common.provenance import refuse_other_run, write_run_record
from suite.common.report import Details, Links, Picture, Report, Section, html
from suite.common.running.remote import Job
from suite.common.stages import (
    MARK,
    Estimate,
    Stage,
    announce,
    claim,
    differences,
    run_stages,
)
from suite.common.work import do_jobs, read_workers_option
from suite.experiments.study.training import training_origin
from suite.judging.requests import Collection, Evaluation
from suite.judging.trials import parse_levels, parse_tracks
from tests.support.jobs import die, diverge, double, pad_one_box
from tracks.common.grid import Cell, Grid, rich_table, table
from tracks.common.provenance import stamp, stamp_text
from tracks.common.work import core_shares, usable_cores

GRID = Grid(
    "Speeds",
    ["who", "m/s"],
    [[Cell("a|b"), Cell("3.1", "good")], [Cell("<all>"), Cell("2.0", "bad")]],
    strong_last=True,
    note="Higher is better.",
)


def test_a_page_holds_everything_and_escapes_what_is_text():
    parts = [
        "x < y", GRID, Picture(b"a png", "a picture"), Links([("a.md", "more")]),
        Details("log", "1 & 2"),
    ]  # fmt: skip
    report = Report("A & B", "It flew.", {"seed": "3"}, [Section("Part", parts)])
    page = html(report, 7)
    assert "<title>A &amp; B</title>" in page and "<p>x &lt; y</p>" in page
    assert f'content="{stamp_text(stamp(1, 7))}"' in page
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


class Writer:
    """Keeps what TensorBoard would be shown."""

    made = []

    def __init__(self, folder, purge_step):
        self.folder, self.first, self.rows = folder, purge_step, []
        Writer.made.append(self)

    def add_scalar(self, name, value, step):
        self.rows.append((name, value, step))

    def flush(self):
        pass


def test_numbers_reach_tensorboard_from_the_first_step_or_the_missing_package_is_named(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(Writer, "made", [])
    package = types.SimpleNamespace(SummaryWriter=Writer)
    monkeypatch.setitem(sys.modules, "tensorboardX", package)
    mirror = curve.tensorboard(tmp_path)
    mirror([])
    mirror([{"iteration": 7, "loss": 0.5, "note": "words"}])
    mirror([{"iteration": 8, "loss": 0.25}])
    (writer,) = Writer.made
    assert (writer.folder, writer.first) == (str(tmp_path / "tensorboard"), 7)
    assert writer.rows == [("loss", 0.5, 7), ("loss", 0.25, 8)]
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(ValueError, match=r"pip install 'diffracing-suite\[tensorboard\]'"):
        curve.tensorboard(tmp_path)


def test_a_cut_last_line_of_a_curve_is_left_out_and_another_damage_is_refused(tmp_path):
    rows = [{"iteration": number} for number in range(3)]
    curve.append(tmp_path, rows)
    path = tmp_path / curve.CURVE
    path.write_text(path.read_text() + '{"iterat')
    assert curve.read(tmp_path) == rows
    text = path.read_text()
    path.write_text(text.replace('"iteration": 1}', '"loss": 1}'))
    with pytest.raises(ValueError, match=r"metrics\.jsonl: line 2 is damaged"):
        curve.read(tmp_path)
    path.write_text(text.replace('"iteration": 1}', "garbage"))
    with pytest.raises(ValueError, match=r"metrics\.jsonl: line 2 is damaged"):
        curve.read(tmp_path)
    (tmp_path / curve.CURVE).write_bytes(b'{"iteration": 0}\n\xff\n{"iteration": 1}\n')
    with pytest.raises(ValueError, match=r"metrics\.jsonl: line 2 is damaged"):
        curve.read(tmp_path)


def test_numpys_value_error_is_a_bug_and_one_raised_on_purpose_in_a_worker_process_a_message():
    with pytest.raises(ValueError) as met:
        pad_one_box(2, [0.0, 0.0])
    frames = traceback.extract_tb(met.value.__traceback__)
    assert frames[-1].filename.endswith("scene.py"), "the case is one with no frame of numpy's"
    assert explain(met.value) is None
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        with pytest.raises(ValueError, match="more than the 0") as met:
            list(pool.map(pad_one_box, [0], [[0.0, 0.0, 0.0]]))
    assert (explain(met.value) or (None,))[0] == UNUSABLE


def test_a_scheduler_that_ends_is_no_bug():
    client = {"__name__": "distributed.comm.core"}
    exec("def connect(): raise OSError('Timed out trying to connect')", client)
    with pytest.raises(OSError, match="Timed out") as met:
        client["connect"]()
    code, said = explain(met.value) or (None, "")
    assert code == FAILED and "finished work is kept: start scheduler and workers again" in said

    def work():
        raise OSError(errno.ENOENT, "no such file", "of a job")

    exec("def result(work): work()", client)
    with pytest.raises(OSError, match="no such file") as met:
        client["result"](work)
    assert explain(met.value) == (UNUSABLE, "no such file: of a job"), "an error of the work"


def test_what_the_system_refuses_is_one_line_with_the_file_and_a_mistake_of_ours_is_a_bug():
    usage = ("EROFS", "ENAMETOOLONG", "ELOOP", "ENXIO", "EACCES")
    trouble = ("ENOSPC", "EIO", "EMFILE", "EFBIG", "ESTALE", "ENOTCONN", "EREMOTEIO")
    for name in (*usage, *trouble):
        number = getattr(errno, name)
        code, said = explain(OSError(number, os.strerror(number), "runs/x")) or (None, "")
        assert code == (UNUSABLE if name in usage else FAILED) and "runs/x" in said, name
        assert name == "ENOSPC" or os.strerror(number).lower() in said
    assert explain(OSError(errno.EBADF, "Bad file descriptor")) is None
    _, said = explain(OSError(errno.EACCES, "Permission denied", "runs")) or (None, "")
    assert said == "permission denied: runs; change its permissions, or give another path"
    code, said = explain(FileExistsError(errno.EEXIST, "File exists", "runs/x")) or (None, "")
    assert code == UNUSABLE and "a file exists: runs/x; give another --out" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("Unable to initialize backend 'cuda': no device\nmore\nlines", "JAX_PLATFORMS is 'cuda'"),
        ("invalid value for environment variable MUJOCO_GL: glx2", "MUJOCO_GL: glx2; unset it"),
    ],
)
def test_a_platform_or_display_that_is_not_there_is_one_line(words, said, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    code, text = explain(RuntimeError(words)) or (None, "")
    assert code == UNUSABLE and said in text and "\n" not in text


@pytest.mark.parametrize(("name", "words"), [("x" * 10_000, "xxx"), ("a\0b", "NUL")])
def test_a_name_that_cannot_be_is_a_short_message(name, words):
    with pytest.raises((OSError, ValueError)) as met:
        open(name)
    code, said = explain(met.value) or (None, "")
    assert code == UNUSABLE and words in said and len(said) < 400


@dataclass(frozen=True)
class Settings:
    trials: int = 3
    track: str = "zigzag"


def stages(done, broken=False):
    def work(name):
        def do(folder):
            if broken and name == "second":
                raise RuntimeError("cut off")
            folder.mkdir(parents=True, exist_ok=True)
            done.append(name)

        return do

    return [
        Stage(name, f"doing the {name}", Estimate(1.0, 1.0), work(name), lambda f: done.append(f))
        for name in ("first", "second")
    ]


def test_a_stage_is_done_once_and_told_again(tmp_path, capfd):
    done = []
    with pytest.raises(RuntimeError):
        run_stages(tmp_path, stages(done, broken=True), Console(), "the run")
    assert done == ["first", tmp_path / "first"] and not (tmp_path / "second" / MARK).exists()
    assert "the run: about 2.0 s" in capfd.readouterr().err
    done.clear()
    took = run_stages(tmp_path, stages(done), Console(), "the run")
    assert done == [tmp_path / "first", "second", tmp_path / "second"]
    assert list(took) == ["first", "second"]
    assert took["first"] == json.loads((tmp_path / "first" / MARK).read_text())["seconds"]
    said = capfd.readouterr().err
    assert "[1/2] doing the first: done before" in said and "[2/2] took" in said
    assert "the run: about 1.0 s" in said
    run_stages(tmp_path, stages([]), Console(), "the run")
    assert "about" not in capfd.readouterr().err


def test_a_folder_of_another_configuration_is_refused(tmp_path):
    claim(tmp_path, Settings(), 0)
    claim(tmp_path, Settings(), 0)
    with pytest.raises(ValueError, match="trials is 3 there, 5 here.*another --out"):
        claim(tmp_path, Settings(trials=5), 0)
    with pytest.raises(ValueError, match=r"there, 'xxx.{,50}\(902 characters\) here\); give"):
        claim(tmp_path, Settings(track="x" * 900), 0)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(ValueError, match="not the record of a run"):
        claim(tmp_path, Settings(), 0)


def test_differences_in_lists_are_named_by_number_and_setting():
    there = {"phases": [{"share": 0.5, "set": []}, {"share": 0.5, "set": ["loss.jerk=1", "a=2"]}]}
    here = {"phases": [there["phases"][0], {"share": 0.5, "set": ["loss.jerk=3", "a=2"]}]}
    assert differences(there, here) == ["phases.2.set.loss.jerk is '1' there, '3' here"]
    assert differences({"set": ["a=1", "a=2"]}, {"set": ["a=2"]}) and not differences(here, here)


def test_an_estimate_is_said_in_figures_for_people_and_missing_memory_is_warned_of(capsys):
    announce(Console(), "training", Estimate(seconds=130, memory_bytes=2e9))
    assert capsys.readouterr().err == "training: about 2 min 10 s and 2.0 GB of memory\n"
    announce(Console(), "training", Estimate(seconds=1, memory_bytes=1e18))
    assert "warning" in capsys.readouterr().err
    durations = ["0.4 s", "10 s", "1 min 00 s", "3 min 20 s", "2 h 05 min"]
    assert [duration(s) for s in (0.44, 9.96, 59.6, 200, 7500)] == durations
    assert [size(b) for b in (5, 812e3, 2.06e9)] == ["5 B", "812 kB", "2.1 GB"]


def test_a_run_record_holds_what_is_needed_to_repeat_it(tmp_path, monkeypatch):
    config = Estimate(seconds=1.0, memory_bytes=2.0)
    monkeypatch.setattr("suite.common.provenance.added_digest", lambda: "of a plugin")
    write_run_record(tmp_path, config, seed=3)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["plugins"] == "of a plugin" and record["config"] == {
        "seconds": 1.0,
        "memory_bytes": 2.0,
    }
    assert record["seed"] == 3 and record["schema"] == 1
    assert set(record) >= {"suite_version", "git_commit", "python", "packages", "machine"}
    assert record["config_type"] == "suite.common.stages.Estimate"


def test_a_run_that_goes_on_keeps_the_commits_that_made_it(tmp_path, monkeypatch):
    for commit in ("aaa", "aaa", "bbb"):
        monkeypatch.setattr(
            "suite.common.provenance.stamp", lambda c=commit, **_: {"git_commit": c}
        )
        write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3, resumed=True)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["earlier"] == {"git_commit": ["aaa"]}
    commits, machine_text = training_origin(tmp_path)
    assert commits == "aaa, bbb" and machine_text.endswith(f", cores: {usable_cores()}")
    write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3)
    assert training_origin(tmp_path)[0] == "bbb", "another run in the same folder"
    assert training_origin(tmp_path / "none") == ("unknown", "unknown")


def test_a_folder_of_another_kind_of_run_is_refused(tmp_path):
    refuse_other_run(tmp_path, Evaluation())  # nothing is there
    write_run_record(tmp_path, Evaluation(), 0)
    refuse_other_run(tmp_path, Evaluation(trials=3))
    with pytest.raises(ValueError, match="holds a run of another kind .* give another --out"):
        refuse_other_run(tmp_path, Collection())
    (tmp_path / "run.json").write_text("[]")
    refuse_other_run(tmp_path, Collection())  # none of ours


def test_progress_without_a_terminal_is_a_plain_line_now_and_then(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    with Console().progress("flying", 100) as update:
        for done in range(101):
            now[0] = done * 0.5
            update(done, "3.1 m/s")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 5
    assert lines[0] == "flying: 20 of 100, 40 s left, 3.1 m/s"
    # Only what was done after the first part counts: the first one also loads and compiles.
    now[0] = 0.0
    with Console().progress("training", 100, begun=80) as update:
        for now[0], done in ((60.0, 85), (72.0, 90)):
            update(done)
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["training: 85 of 100", "training: 90 of 100, 24 s left"]


CORES = sorted(os.sched_getaffinity(0))


def jobs(*tasks):
    return [Job(task, Path("nowhere")) for task in tasks]


class Recorded(Console):
    """A console that keeps what it would show."""

    def __init__(self):
        self.shown = []

    @contextmanager
    def progress(self, label, total, begun=0.0):
        yield lambda done, note="": self.shown.append((done, total))


def test_more_processes_than_cores_are_refused_where_each_needs_some(monkeypatch):
    monkeypatch.setattr("suite.common.work.usable_cores", lambda: 2)
    assert read_workers_option("3") == 3 and read_workers_option("2", whole_cores=True) == 2
    assert read_workers_option("a:1", whole_cores=True) == "tcp://a:1"
    with pytest.raises(ValueError, match="--workers is 3; allowed is 1 to 2"):
        read_workers_option("3", whole_cores=True)


@pytest.mark.extended
@pytest.mark.skipif(len(CORES) < 2, reason="needs two cores")
def test_jobs_come_back_in_order_from_processes_that_share_no_core_or_say_what_failed():
    console = Recorded()
    found = do_jobs(double, jobs(5, 6, 7), 2, console, "doubling")
    assert [value for value, _ in found] == [10, 12, 14]
    assert {tuple(cores) for _, cores in found} <= set(map(tuple, core_shares(2)))
    amounts = [done for done, total in console.shown if total == 3]
    assert amounts == sorted(amounts) and amounts[0] == 0.5 and amounts[-1] == 3
    with pytest.raises(WorkFailed, match=r"dying: a process died; the products.*exit code 7"):
        do_jobs(die, jobs(1), 2, Console(), "dying")
    with pytest.raises(WorkFailed, match=r"^training 1 diverged$"):
        do_jobs(diverge, jobs(1), 2, Console(), "training")


@pytest.mark.parametrize("width", [40, 80, 120, 200])
def test_a_table_in_a_narrow_terminal_keeps_every_text(width, monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", str(width))
    headers = "policy,track,level,trials,success,gates,v_max [m/s],v_mean [m/s],lap [s],ended"
    row = "race;circular;0;9;99 % [72, 100];8.0;6.97 [6.71, 7.11];5.43;7.57 [6.66, 8.7];collision 1"
    Console().show(rich_table(table(headers.split(","), [row.split(";")])))
    lines = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out).splitlines()
    assert max(map(len, lines)) <= width
    parts = zip(*(line.split("│")[1:-1] for line in lines if "│" in line), strict=True)
    assert ";".join("".join(part) for part in parts).replace(" ", "") == row.replace(" ", "")
    whole = [text for line in lines for text in line.replace("│", " ").split()]
    assert width == 40 or {"circular", "[6.71,", "collision"} <= {*whole}
