"""The declarations, the stages that they ask for, and what a report is made of."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from suite.common.errors import WorkFailed
from suite.common.report import Picture
from suite.common.stages import is_done
from suite.delta.fit import DeltaFit, PointMassFit, ReplayErrors
from suite.delta.replay import nominal_model
from suite.delta.run import FLOWN, errors
from suite.loop import charts, delta_action, hidden_effect, work
from suite.loop.compare import compare
from suite.loop.config import resolve
from suite.loop.variants import DeltaModel, Variant
from suite.loop.work import LoopRun, Quiet, plan
from suite.train.config import PointMassConfig
from tests.support.loops import trial_result
from tracks.common.grid import Grid

LOOPS = (delta_action.LOOP, hidden_effect.LOOP)


@pytest.mark.parametrize("loop", LOOPS, ids=("delta", "hidden"))
def test_a_declaration_names_what_it_has(loop):
    names = [variant.name for variant in loop.variants]
    assert len(set(names)) == len(names) and "before" in names
    folders = {model.folder for model in loop.models}
    assert {variant.delta for variant in loop.variants if variant.delta} == folders or loop.hidden
    assert {variant.delta for variant in loop.variants} - {None} <= folders
    assert {one.variant for one in loop.shown} <= set(names) and len(loop.shown) == 2
    if not loop.hidden:
        assert not any(one.diagnosed or one.simulated for one in loop.variants)
    # A model is of the vehicle that is flown where it corrects.
    diagnosed = {model.folder: model.diagnosed for model in loop.models}
    for variant in loop.variants:
        assert variant.delta is None or variant.diagnosed == diagnosed[variant.delta]


def test_another_variant_is_another_two_stages():
    longer = Variant("longer", "judging another", "for longer", delta="other")
    loop = replace(
        delta_action.LOOP,
        variants=(*delta_action.LOOP.variants, longer),
        models=(*delta_action.LOOP.models, DeltaModel("other", "fitting another")),
    )
    run = LoopRun(loop, resolve(recipe="small"), Path("out"), Quiet())
    names = [stage.name for stage in plan(run)]
    assert names.index("other") < names.index("tuned-longer") < names.index("eval-longer")
    assert len(names) == 9 + 3


def test_the_first_policy_is_trained_or_taken():
    for policy, first in ((None, "train"), ("racer", "given")):
        config = resolve(recipe="small", policy=policy)
        run = LoopRun(delta_action.LOOP, config, Path("out"), Quiet())
        stages = plan(run)
        assert stages[0].name == first and len(stages) == 9
        assert run.policy(run.loop.variants[0]) == Path("out") / first / "policy"
        assert all(stage.needs.seconds > 0 for stage in stages if stage.name != "given")
    assert run.policy(run.loop.variants[2]) == Path("out/tuned-with/policy")


def test_flights_that_cannot_be_fitted_end_the_loop_with_advice(tmp_path, monkeypatch):
    def none(*args):
        raise ValueError("no window of 1.0 s in 3 flights")

    monkeypatch.setattr(work, "fit_delta", none)
    config = resolve(recipe="small", trials=3)
    run = LoopRun(delta_action.LOOP, config, tmp_path, Quiet())
    stage = next(stage for stage in plan(run) if stage.name == "delta")
    with pytest.raises(WorkFailed, match="no window.*--iterations"):
        stage.work(tmp_path / "delta")
    assert not is_done(tmp_path / "delta")


@pytest.mark.parametrize("levels", [1, 4])
def test_names_of_cells_do_not_run_into_each_other(levels, monkeypatch):
    trials = [
        trial_result(0, True, level)._replace(track=track)
        for track in ("zigzag", "circular", "ellipse")
        for level in range(levels)
    ]
    drawn = []
    monkeypatch.setattr(charts, "png", lambda figure: drawn.append(figure) or b"")
    charts.comparison_chart(compare(dict.fromkeys(("before", "without", "with"), trials)))
    for axes in drawn[0].axes:
        drawn[0].draw_without_rendering()
        boxes = [label.get_window_extent() for label in axes.get_xticklabels()]
        apart = [right.x0 - left.x1 for left, right in pairwise(boxes)]
        assert len(boxes) == 3 * levels + 1 and min(apart) > 0


FIT = {"params": {}, "without": ReplayErrors(0.4, 0.8), "with_delta": ReplayErrors(0.1, 0.3)}
CURVE = [{"iteration": k, "held_out_m": 0.4 - 0.1 * k, "fit_m": 0.3 - 0.1 * k} for k in range(3)]


@pytest.mark.parametrize(
    ("fitted", "about", "corrected"),
    [
        (
            PointMassFit(
                **FIT,
                curve=CURVE,
                identified=nominal_model(PointMassConfig()),
                rival=ReplayErrors(0.2, 0.5),
            ),
            {},
            "point mass",
        ),
        (DeltaFit(**FIT, curve=CURVE), {"vehicle": {"name": "racer5"}}, "quadrotor of racer5"),
    ],
    ids=("point mass", "quadrotor"),
)
def test_a_report_tells_of_whatever_was_corrected(fitted, about, corrected):
    flown = {key: error._asdict() for key, error in errors(fitted).items()}
    rest = {"windows": {"fit": 9, "held_out": 3}, "held_out": ["a"], "horizon_s": 1.0}
    section = delta_action._delta({**flown, **about, **rest, "curve": CURVE})
    words, grid, picture = section.parts
    assert isinstance(words, str) and isinstance(grid, Grid) and isinstance(picture, Picture)
    assert f"flown again in the {corrected} for 1 s" in words
    assert [row[0].text for row in grid.rows] == [FLOWN[key] for key in flown]
    assert [row[-1].text for row in grid.rows][:: len(flown) - 1] == ["100 %", "25 %"]
    assert picture.png
