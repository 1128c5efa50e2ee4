"""The benchmark of a policy's step, on a small policy."""

import json
from pathlib import Path

import pytest

from policies.formats.c.compiler import find_compiler
from suite import cli
from suite.experiments.bench import policy
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
