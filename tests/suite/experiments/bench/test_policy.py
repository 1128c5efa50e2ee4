"""The benchmarks of the judge and of a policy's engines, timed in turn."""

import json
from itertools import count
from pathlib import Path

import pytest

from policies.formats.c.compiler import find_compiler
from suite import cli
from suite.common.errors import WorkFailed
from suite.experiments.bench import diagnose, judge, policy, sysid_baseline
from suite.experiments.bench.compare import Comparison, Figure, compare_times, in_turn
from tests.support.small_policy import small_checkpoint


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler: cc, or what CC names")
def test_every_engine_is_timed_and_the_ratio_is_of_the_times(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder, run = str(small_checkpoint(tmp_path)), policy.run
    monkeypatch.setattr(policy, "run", lambda asked: run(asked, rounds=1))
    assert cli.main(["bench", "policy", "--policy", folder, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["details"]["policy"] == Path(folder).name
    ours, baseline = answer["ours"]["value"], answer["baseline"]["value"]
    assert answer["ratio"] == pytest.approx(baseline / ours)
    rows = {name: row for name, row in answer["details"].items() if isinstance(row, dict)}
    assert set(rows) >= {"C float32", "C int8", "ONNX Runtime", "torch"}
    for row in rows.values():
        assert 0 < row["median_us"] <= row["p99_us"] <= row["max_us"]
    assert rows["C int8"]["weight_bytes"] < 0.4 * rows["C float32"]["weight_bytes"]
    estimate = rows["C float32"]["estimate_cortex_m7_480mhz_ms"]
    assert estimate == pytest.approx(rows["C float32"]["multiply_adds"] * 3.0 / 480e3)


def test_bench_times_both_sides_in_turn():
    calls = []
    ticks = count()
    sides = {
        "ours": lambda: calls.append("ours"),
        "baseline": lambda: (calls.append("baseline"), next(ticks), next(ticks)),
    }
    taken = in_turn(sides, 3, clock=lambda: next(ticks))
    assert calls == ["ours", "baseline"] * 4
    assert taken == {"ours": [1] * 3, "baseline": [3] * 3}
    assert compare_times("a", taken, 6.0, "steps/s", {}).baseline == Figure(2.0, "steps/s")
    assert in_turn(sides, 3, most_s=0.0).keys() == {"ours", "baseline"} and len(calls) == 12
    figures = Figure(6.0, "steps/s"), Figure(2.0, "steps/s")
    assert Comparison("a", *figures).ratio == pytest.approx(3.0)


def test_without_a_compiler_or_packages_it_says_what_to_install(monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    with pytest.raises(WorkFailed, match="no C compiler"):
        policy.run()
    monkeypatch.setattr(sysid_baseline, "is_installed", lambda: False)
    with pytest.raises(WorkFailed, match=r"pip install 'mujoco\[sysid\]'"):
        diagnose.run()


def test_both_sides_fly_the_same_trials_to_the_same_end(tmp_path, monkeypatch, capsys):
    folder, run = str(small_checkpoint(tmp_path)), judge.run
    monkeypatch.setattr(judge, "run", lambda: run(folder, trials=3, time_limit_s=0.2))
    assert cli.main(["bench", "judge", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["ours"]["value"] > 0 and answer["baseline"]["value"] > 0
    assert answer["ratio"] == answer["ours"]["value"] / answer["baseline"]["value"]
    assert answer["details"]["trials_that_end_alike"] == 3
    assert answer["details"]["images_a_trial"] > 1
