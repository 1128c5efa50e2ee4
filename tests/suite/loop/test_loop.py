"""The declarations, the stages that they ask for, and what a report is made of."""

from dataclasses import replace
from pathlib import Path

import pytest

from suite.common.errors import WorkFailed
from suite.common.stages import is_done
from suite.loop import delta_action, hidden_effect, work
from suite.loop.config import resolve
from suite.loop.variants import DeltaModel, Variant
from suite.loop.work import LoopRun, Quiet, plan

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
