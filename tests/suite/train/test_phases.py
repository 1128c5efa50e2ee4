"""Phases of a run: what changes when, a user's changes in them, and what is refused."""

from dataclasses import replace

import pytest

from suite.train.config import Phase, TrainConfig
from suite.train.overrides import (
    changed,
    check_phases,
    in_every_phase,
    phase_configs,
    phase_ends,
    without_quadrotor,
)
from suite.train.recipes import named_recipe, with_iterations

RUN = with_iterations(
    TrainConfig(
        phases=(
            Phase(0.5),
            Phase(0.3, ("loss.progress=2.0", "optimizer.rate=1e-3")),
            Phase(0.2, ("spec.rate_hz=30.0",)),
        )
    ),
    10,
)


def test_a_phase_changes_what_it_says_and_keeps_what_came_before():
    assert phase_ends(RUN) == (5, 8, 10)
    first, second, third = phase_configs(RUN)
    assert [one.optimizer.iterations for one in (first, second, third)] == [5, 3, 2]
    assert [one.loss.progress for one in (first, second, third)] == [1.2, 2.0, 2.0]
    assert [one.spec.rate_hz for one in (first, second, third)] == [15.0, 15.0, 30.0]
    assert all(one.phases == () for one in (first, second, third))
    assert phase_configs(TrainConfig()) == (TrainConfig(),)


def test_phases_share_any_number_of_iterations_without_a_rest():
    recipe = named_recipe("race")
    for total in (3, 7, 100, 4500, 4501):
        ends = phase_ends(with_iterations(recipe, total))
        assert ends[-1] == total and list(ends) == sorted(ends)


def test_a_users_change_holds_in_every_phase_or_in_the_one_that_is_named():
    everywhere = phase_configs(changed(RUN, ["loss.progress=0.4"]))
    assert [one.loss.progress for one in everywhere] == [0.4] * 3
    assert everywhere[1].optimizer.rate == 1e-3, "other changes of the phase stay"
    alone = phase_configs(changed(RUN, ["phases.3.loss.progress=0.4", "loss.jerk=0.5"]))
    assert [one.loss.progress for one in alone] == [1.2, 2.0, 0.4]
    assert [one.loss.jerk for one in alone] == [0.5] * 3
    always = phase_configs(in_every_phase(RUN, "loss", progress=0.7))
    assert [one.loss.progress for one in always] == [0.7] * 3


def test_quadrotors_leave_every_phase():
    recipe = without_quadrotor(named_recipe("race"))
    check_phases(recipe)
    assert all(one.quadrotor is None for one in phase_configs(recipe))


@pytest.mark.parametrize(
    ("phases", "words"),
    [
        ((Phase(0.5), Phase(0.4)), "shares of phases add up to 0.9, allowed is 1"),
        ((Phase(0.5), Phase(0.5, ("loss.progres=1",))), "phase 2: .*Did you mean 'progress'"),
        ((Phase(0.5), Phase(0.5, ("episode.batch=2",))), "phase 2 changes episode.batch"),
        ((Phase(0.5), Phase(0.5, ("spec.hidden_size=64",))), "phase 2 changes spec"),
        ((Phase(0.5), Phase(0.5, ("episode.image_stride=7",))), "image_stride is 7"),
    ],
)
def test_phases_that_cannot_be_trained_are_refused(phases, words):
    with pytest.raises(ValueError, match=words):
        check_phases(replace(RUN, phases=phases))


def test_a_change_of_a_phase_that_is_not_there_is_refused():
    for number in ("0", "4", "x"):
        with pytest.raises(ValueError, match="this run has 3 phases"):
            changed(RUN, [f"phases.{number}.loss.progress=1"])
