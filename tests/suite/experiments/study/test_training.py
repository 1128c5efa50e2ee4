"""What a training's files say: its curve without compilation, and the commits that made it."""

import json

from suite.experiments.study.training import curve_of


def test_time_leaves_compilation_out(tmp_path):
    seconds = [(0, 30.0, True), (1, 2.0, False), (2, 11.0, True), (3, 3.0, False), (4, 4.0, False)]
    rows = [{"iteration": k, "seconds": s, "cold": cold} for k, s, cold in seconds]
    watched = [{"iteration": k, "gates": float(k)} for k in (0, 3, 5)]
    for name, lines in (("metrics.jsonl", rows), ("validation.jsonl", watched)):
        (tmp_path / name).write_text("".join(json.dumps(line) + "\n" for line in lines))
    points, compiling = curve_of(tmp_path, 10)
    assert [(p["steps"], p["time"], p["gates"]) for p in points] == [
        (0, 0.0, 0.0), (30, 3 + 2 + 3, 3.0), (50, 3 + 2 + 3 + 3 + 4, 5.0),
    ]  # fmt: skip
    assert compiling == 27 + 8
