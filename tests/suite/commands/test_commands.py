"""The small commands: tracks, effects, bench, and what people write for levels and tracks."""

import json
from itertools import count

import pytest

from suite import cli
from suite.common.choices import at_least, parse_levels, parse_tracks
from suite.common.console import Console
from suite.common.estimate import Estimate, announce
from suite.common.provenance import run_record, write_run_record
from suite.experiments.bench.compare import Comparison, Figure, in_turn


@pytest.mark.parametrize(
    ("text", "levels"),
    [("3", [3]), ("0,3, 9", [0, 3, 9]), ("7-9,0,8", [7, 8, 9, 0]), ("all", list(range(10)))],
)
def test_levels(text, levels):
    assert parse_levels(text) == levels


@pytest.mark.parametrize("text", ["10", "-1", "3-1", "", "easy", "1,,2", "0-10"])
def test_levels_that_are_none_are_refused_by_name(text):
    with pytest.raises(ValueError, match="--difficulty"):
        parse_levels(text)


def test_tracks():
    assert parse_tracks("all") == ["zigzag", "circular", "ellipse"]
    assert parse_tracks("ellipse,my/course.toml") == ["ellipse", "my/course.toml"]
    with pytest.raises(ValueError, match="Did you mean 'zigzag'"):
        parse_tracks("ellipse,zigzg")


def test_an_option_that_is_too_small_is_named():
    at_least("--trials", 1, 1)
    with pytest.raises(ValueError, match="--trials is 0; it must be 1 or more"):
        at_least("--trials", 0, 1)
    with pytest.raises(ValueError, match="nan"):
        at_least("--limit", float("nan"), 1)


def test_tracks_command_lists_and_draws(tmp_path, capfd):
    assert cli.main(["tracks", "--json"]) == 0
    families = json.loads(capfd.readouterr().out)["families"]
    assert families["zigzag"]["judged"] and not families["random"]["judged"]
    args = ["tracks", "zigzag", "--difficulty", "0,9", "--seed", "4", "--out", str(tmp_path)]
    assert cli.main(args) == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["zigzag-0-4.png", "zigzag-9-4.png"]
    assert (tmp_path / names[0]).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["tracks", "elipse"], "Did you mean 'ellipse'?"),
        (["tracks", "ellipse", "--difficulty", "12"], "level 12 is not 0 to 9"),
        (["effects", "linear_darg"], "Did you mean 'linear_drag'?"),
    ],
)
def test_wrong_names_are_code_2_and_one_line(args, words, capsys):
    assert cli.main(args) == 2
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1


def test_effects_command_lists_and_describes(capfd):
    assert cli.main(["effects", "--json"]) == 0
    effects = json.loads(capfd.readouterr().out)["effects"]
    assert effects["linear_drag"]["parameters"]["coefficient"]["unit"] == "1/s"
    assert cli.main(["effects", "linear_drag"]) == 0
    assert "coefficient x 3 [1/s]" in capfd.readouterr().out


def test_bench_times_both_sides_in_turn():
    calls = []
    ticks = count()
    ours, baseline = in_turn(
        lambda: calls.append("ours"),
        lambda: (calls.append("baseline"), next(ticks), next(ticks)),
        repeats=3,
        clock=lambda: next(ticks),
    )
    assert calls == ["ours", "baseline"] * 4
    assert (ours, baseline) == (1, 3)
    figures = Figure(6.0, "steps/s"), Figure(2.0, "steps/s")
    assert Comparison("a", *figures).ratio == pytest.approx(3.0)


def test_an_estimate_is_said_and_missing_memory_is_warned_of(capsys):
    announce(Console(), "training", Estimate(seconds=130, memory_bytes=2e9))
    assert capsys.readouterr().err == "training: about 2 min 10 s and 2.0 GB of memory\n"
    announce(Console(), "training", Estimate(seconds=1, memory_bytes=1e18))
    assert "warning" in capsys.readouterr().err


def test_a_run_record_holds_what_is_needed_to_repeat_it(tmp_path):
    config = Estimate(seconds=1.0, memory_bytes=2.0)
    write_run_record(tmp_path, config, seed=3)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["config"] == {"seconds": 1.0, "memory_bytes": 2.0}
    assert record["seed"] == 3 and record["schema"] == 1
    assert set(record) >= {"suite_version", "git_commit", "python", "packages", "machine"}
    assert run_record(config, None)["config_type"] == "suite.common.estimate.Estimate"


def test_a_run_that_goes_on_keeps_the_commits_that_made_it(tmp_path, monkeypatch):
    from suite.experiments.study.training import commit_of

    for commit in ("aaa", "aaa", "bbb"):
        monkeypatch.setattr(
            "suite.common.provenance.stamp", lambda c=commit, **_: {"git_commit": c}
        )
        write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3, goes_on=True)
    assert json.loads((tmp_path / "run.json").read_text())["earlier_commits"] == ["aaa"]
    assert commit_of(tmp_path / "policy") == "aaa, bbb"
    write_run_record(tmp_path, Estimate(1.0, 2.0), seed=3)
    assert commit_of(tmp_path / "policy") == "bbb", "another run in the same folder"
    assert commit_of(tmp_path / "none" / "policy") == "unknown"
