"""Comparisons of evaluations: published examples, coverage, and what is refused."""

import json
import shutil
from math import erf, sqrt

import numpy as np
import pytest
from scipy.stats import t as student

from eval.judging.results import write_results
from eval.judging.statistics import over_seeds, paired_success, wilson
from policies import shipped
from suite.commands import compare
from suite.common.console import Quiet
from suite.judging.comparing import compare_runs, compare_seeds, paired_sentence, read_runs
from suite.judging.content import PolicyContent
from suite.judging.requests import Evaluation
from tests.support import commands
from tests.support.judged_cells import cut_short, result


@pytest.mark.extended
def test_the_hierarchical_bootstrap_of_a_difference_covers_as_it_says():
    rng, hit, count = np.random.default_rng(3), 0, 500
    seeds, trials, spread = 8, 60, 0.5

    def mean(level):
        return 0.5 * (1 + erf(level / sqrt(2 + spread**2) / sqrt(2)))

    for _ in range(count):
        tracks = rng.normal(0, 1, trials)

        def flown(level, tracks=tracks):
            skill = level + rng.normal(0, spread, (seeds, 1)) + tracks
            return (rng.normal(size=(seeds, trials)) < skill).astype(float)

        first, second = flown(0.8), flown(0.4)
        found = over_seeds(first, second, draws=200)
        truth = mean(0.8) - mean(0.4)
        hit += found.low <= truth <= found.high
    assert 0.93 <= hit / count <= 0.97, hit


def test_the_interval_of_a_small_layout_is_that_of_its_mean_squares_and_one_seed_has_none():
    """Satterthwaite 1946: the mean's variance is (MS seeds + MS trials - MS rest) / (S T)."""
    table = [[-1, -4, 2, -1, 3], [3, 0, 0, 3, -1], [2, -3, -1, -4, 1], [2, 0, 2, 0, 1]]
    values = np.array(table, float)
    seeds, trials = values.shape
    rest = values - values.mean(1, keepdims=True) - values.mean(0) + values.mean()
    squares = np.array([
        trials * values.mean(1).var(ddof=1),
        seeds * values.mean(0).var(ddof=1),
        (rest**2).sum() / ((seeds - 1) * (trials - 1)),
    ])  # fmt: skip
    variance = squares @ [1, 1, -1] / values.size
    freedom = [seeds - 1, trials - 1, (seeds - 1) * (trials - 1)]
    degrees = variance**2 / ((squares / values.size) ** 2 / freedom).sum()
    found = over_seeds(values)
    half = student.ppf(0.975, degrees) * sqrt(variance)
    assert (found.high - found.low) / 2 == pytest.approx(half, rel=0.03)
    for values in ((np.ones((1, 5)),), (np.ones((2, 5)), np.ones((2, 4)))):
        with pytest.raises(ValueError, match="two or more seeds of each method and two"):
            over_seeds(*values)


def run_of(
    folder,
    successes,
    judged=None,
    policy="ours",
    weights=None,
    settings=None,
    track=None,
    **digests,
):
    rows = [result(seed, bool(success), policy) for seed, success in enumerate(successes)]
    rows = [row._replace(track=track or row.track) for row in rows]
    summary = {"judged": judged or Evaluation(), "sha256": {"vehicle": "a", **digests}}
    summary["policies"] = [{"sha256": weights or str(folder), "settings_sha256": settings}]
    write_results(folder, rows, table_markdown="", summary=summary, seed=0)
    return folder


def test_runs_are_paired_refused_or_taken_as_seeds(tmp_path, capsys):
    rng = np.random.default_rng(0)
    a = run_of(tmp_path / "a", rng.random(40) < 0.9)
    b = run_of(tmp_path / "b", rng.random(40) < 0.5)
    found = compare_runs(*read_runs(a), *read_runs(b))
    assert found["trials"] == 40 and found["difference"].value > 0
    assert " minus " in found["sentence"] and "McNemar" in found["sentence"]
    answer = compare.run(compare.Config((a, b), seeds=True), Quiet())
    assert "2 training seeds" in answer["comparisons"][0]["sentence"]
    (there,), (back,) = (
        commands.answer(capsys, "compare", one, "--against", other)["comparisons"]
        for one, other in ((a, b), (b, a))
    )
    assert there["difference"]["value"] == -back["difference"]["value"] == found["difference"].value
    for judged, digests, said in (
        (Evaluation(simulator="mjx"), {}, r"simulator \(mujoco and mjx\);"),
        (Evaluation(time_limit_s=10.0), {}, r"time_limit_s \(20.0 and 10.0\);"),
        (None, {"sensors": "b", "track my.toml": "c"}, "sensors, track my.toml;"),
    ):
        apart = run_of(tmp_path / "c", [True] * 40, judged, **digests)
        with pytest.raises(ValueError, match=f"judged under different conditions: {said}"):
            compare_runs(*read_runs(a), *read_runs(apart))
    with pytest.raises(ValueError, match="10 trials are in only one of them"):
        compare_runs(*read_runs(a), *read_runs(run_of(tmp_path / "d", [True] * 30)))
    for folder, said in (
        (tmp_path, "no trials.parquet"),
        (None, r"of two policies .* \(given: 1\)"),
    ):
        with pytest.raises(ValueError, match=said):
            compare.run(compare.Config((a, folder) if folder else (a,)), Quiet())


def test_a_track_file_is_one_track_by_any_path_to_it(tmp_path):
    def judged(folder, track, digest="c"):
        return run_of(tmp_path / folder, [True, False], track=track, **{f"track {track}": digest})

    a, b = judged("a", "tracks/my.toml"), judged("b", "/home/me/my.toml")
    (found,) = compare.run(compare.Config((a, b)), Quiet())["comparisons"]
    assert found["trials"] == 2
    with pytest.raises(ValueError, match="different conditions: track my.toml;"):
        compare.run(compare.Config((a, judged("c", "my.toml", "d"))), Quiet())


def test_a_summary_that_is_none_and_a_trial_that_is_there_twice_are_refused(tmp_path):
    run_of(tmp_path, [True])
    for summary, said in (
        ("[1]", "is a list"),
        ('{"judged": [1]}', "'judged' is missing or not a dict"),
        ("{", "not JSON"),
        ('{"judged": {}, "sha256": {}, "policies": []}', "has no SHA-256 for each of the 1"),
        ('{"judged": {}, "sha256": {}, "policies": [{}]}', "has no SHA-256 for each of the 1"),
    ):
        (tmp_path / "summary.json").write_text(summary)
        with pytest.raises(ValueError, match=rf"summary\.json: .*{said}"):
            read_runs(tmp_path)
    rows, summary = [result(0)] * 2, {"judged": {}, "sha256": {}, "policies": []}
    write_results(tmp_path, rows, table_markdown="", summary=summary, seed=0)
    with pytest.raises(ValueError, match="holds a trial twice"):
        read_runs(tmp_path)


def test_two_methods_are_compared_over_their_seeds(tmp_path):
    rng = np.random.default_rng(1)
    folders = {
        name: run_of(tmp_path / name, rng.random(60) < rate)
        for name, rate in (("a0", 0.9), ("a1", 0.95), ("b0", 0.4), ("b1", 0.3))
    }
    runs = {name: read_runs(folder)[0] for name, folder in folders.items()}
    found = compare_seeds([runs["a0"], runs["a1"]], [runs["b0"], runs["b1"]])
    assert found["mean"].value == pytest.approx(
        np.mean(found["success_by_seed"][0]) - np.mean(found["success_by_seed"][1])
    )
    assert "a difference of +" in found["sentence"] and len(found["spread"]) == 2
    # With two seeds, Student's t would give an interval beyond all possible rates.
    rates = [0.05, 0.95]
    few = [read_runs(run_of(tmp_path / f"{r}", rng.random(60) < r))[0] for r in rates]
    assert compare_seeds(few)["mean"][1:] == (0.0, 1.0)
    assert compare_seeds(few, few[::-1])["mean"][1:] == (-1.0, 1.0)
    same = read_runs(run_of(tmp_path / "same", [True] * 60))[0]
    paired = paired_success(*[np.ones(60)] * 2)
    for others, low in (((), wilson(60, 60).low), ([same, same], paired.low)):
        found = compare_seeds([same, same], others)["mean"]
        assert found.low == pytest.approx(low) and found.low < found.value - 0.05


def test_a_run_or_a_policy_that_is_given_twice_and_one_trial_are_refused(tmp_path):
    runs = [
        run_of(tmp_path / str(index), [True] * trials, weights=weights)
        for index, (weights, trials) in enumerate(
            (("x", 2), ("x", 2), ("y", 2), ("x", 1), ("y", 1))
        )
    ]
    (tmp_path / "link").symlink_to(runs[0])
    for other in (runs[0], runs[1] / "../0", tmp_path / "link"):
        for config in (compare.Config((runs[0], other)), compare.Config((runs[0],), (other,))):
            with pytest.raises(ValueError, match=f"{other} is given twice"):
                compare.run(config, Quiet())
    with pytest.raises(ValueError, match="have the same policy, which is one training seed"):
        compare.run(compare.Config(tuple(runs[:2]), seeds=True), Quiet())
    compare.run(compare.Config(tuple(runs[:2])), Quiet())
    compare.run(compare.Config((runs[0], runs[2]), seeds=True), Quiet())
    with pytest.raises(ValueError, match="given are 2 seeds of 1 trials"):
        compare.run(compare.Config(tuple(runs[3:]), seeds=True), Quiet())


SPEEDS = Evaluation(speed=(0.5, 1.0), monitor=True)


def test_rows_of_other_speeds_or_the_monitor_are_no_training_seeds(tmp_path):
    plain, other, *unlike = (
        read_runs(run_of(tmp_path / policy, [True, False], SPEEDS, policy=policy))[0]
        for policy in ("a@0.5", "b@0.5", "a", "a@1", "a@0.5+monitor")
    )
    assert compare_seeds([plain, other], unlike[:1] * 2)["trials"] == 2
    for run in unlike:
        with pytest.raises(ValueError, match="are no training seeds of one method"):
            compare_seeds([plain, run])


def test_a_sentence_prints_no_rate_with_a_failure_as_100_percent():
    failed_once = np.arange(3000) > 0
    said = paired_sentence("a", "b", failed_once, ~failed_once)
    assert "a succeeded in 99.97 % and b in 0.03 % of the same 3000 trials" in said


def test_trainings_that_differ_in_the_seed_only_have_the_same_settings(tmp_path):
    (tmp_path / "weights.safetensors").touch()
    digests = []
    for training in (
        {"config": {"seed": 0, "rate": 1.0}, "iteration": 9},
        {"config": {"seed": 1, "rate": 1.0}, "iteration": 9},
        {"config": {"seed": 0, "rate": 2.0}, "iteration": 9},
        {"config": {"seed": 0, "rate": 1.0}, "iteration": 8},
        {},
        [],
    ):
        (tmp_path / "config.json").write_text(json.dumps({"training": training}))
        digests.append(PolicyContent.of(tmp_path).settings_digest)
    assert digests[0] == digests[1] and len(set(digests[1:4])) == 3 and digests[4:] == [None] * 2
    assert PolicyContent.of("race").settings_digest


def test_seeds_of_several_settings_are_noted(tmp_path, capsys):
    unknown, a, b, other = (
        run_of(tmp_path / f"{index}", [True, False], settings=settings)
        for index, settings in enumerate((None, "x", "x", "y"))
    )
    for config, is_noted in (
        (compare.Config((unknown, a, b), seeds=True), False),
        (compare.Config((unknown, a, other), seeds=True), True),
        (compare.Config((a, b), against=(other, unknown)), False),
        (compare.Config((a, other)), False),
    ):
        compare.run(config, Quiet())
        said = " ".join(capsys.readouterr().err.split())
        assert ("1 and " in said and "trained with different settings" in said) == is_noted
        is_unknown = unknown in (*config.runs, *config.against)
        assert ("no settings of a training are recorded" in said) == is_unknown


def test_other_versions_are_noted(tmp_path, capsys):
    judged = Evaluation(simulator="rotorpy")
    folders = [run_of(tmp_path / name, [True, False], judged, settings="x") for name in "ab"]
    for folder, version in zip(folders, ("3.3.0", "3.4.0"), strict=True):
        versions = dict.fromkeys(("mujoco", "mujoco-mjx", "jax", "rotorpy"), version)
        run = {"packages": versions, "plugins": version[2], "machine": {"processor": version[:3]}}
        (folder / "run.json").write_text(json.dumps(run))
    answer = compare.run(compare.Config(tuple(folders), seeds=True), Quiet())
    assert answer["comparisons"][0]["runs"] == [[f"{folder}" for folder in folders]]
    noted = [note.partition("(")[2].partition(")")[0] for note in answer["notes"]]
    numbers = [f"{name}: 3.3.0, 3.4.0" for name in ("mujoco", "jax", "rotorpy")]
    assert noted == [*numbers, "plugins: 3, 4", "processor: 3.3, 3.4"]
    said = " ".join(capsys.readouterr().err.split())
    assert all(note in said for note in answer["notes"])


def test_runs_of_one_policy_or_of_other_speeds_are_noted(tmp_path, capsys):
    a, b, fast = (
        run_of(tmp_path / name, [True, False], judged, policy, weights="w")
        for name, judged, policy in (("a", None, "p"), ("b", None, "p"), ("c", SPEEDS, "p@1"))
    )
    for other, said in ((b, "have the same policy"), (fast, "--speed or --monitor differ")):
        for config in (compare.Config((a, other)), compare.Config((a,), against=(other,))):
            compare.run(config, Quiet())
            assert said in " ".join(capsys.readouterr().err.split())


def test_a_policy_under_two_names_is_noted(tmp_path, monkeypatch, capsys):
    own = shutil.copytree(shipped.locate("race-small"), tmp_path / "small")
    cut_short(monkeypatch, seconds=0.1, stop_after=1)
    line = "--track zigzag --trials 1 --policy race-small"
    assert commands.evaluate(tmp_path / "out", line, own) == 130
    assert "race-small and small have the same policy" in capsys.readouterr().err
