"""The page of an accelerator, at a small size on the CPU."""

from dataclasses import replace

import pytest

from suite import cli
from suite.experiments import gpu
from suite.train.recipes import named_recipe
from tests.support.documents import page, reproduce

SMALL = (
    *("--worlds", "2", "3", "--train-worlds", "2", "--seconds", "0.1", "--trials", "3"),
    *("--paired-trials", "3", "--timed-s", "0.2", "--matrix", "32"),
)


def short(name):
    """Return a recipe whose rollouts are six decisions long."""
    recipe = named_recipe(name)
    return replace(
        recipe,
        episode=replace(recipe.episode, steps=6),
        phases=(replace(recipe.phases[0], share=1.0, set=()),),
    )


@pytest.mark.slow
def test_the_page_has_speeds_a_training_and_the_cpus_outcomes(tmp_path, monkeypatch):
    monkeypatch.setattr(gpu, "named_recipe", short)
    assert reproduce(tmp_path, "gpu", *SMALL) == 0
    text, numbers = page(tmp_path, "gpu")
    assert {(row["model"], row["worlds"]) for row in numbers["trainer"]} == {
        (model, worlds) for model in ("quadrotor", "point") for worlds in (2, 3)
    }
    assert all(row["seconds"] > 0 and row["operations"] > 1e6 for row in numbers["trainer"])
    assert [row["worlds"] for row in numbers["judge"]] == [2, 3]
    # On a CPU both sides are the same program.
    assert numbers["paired"]["mjx on the CPU"]["same_ending"] == 3
    training = numbers["training"]
    assert len(training["curve"]) == training["iterations"] >= 1
    assert "## A short training" in text


def test_a_training_whose_speed_is_not_measured_is_refused(tmp_path, capsys):
    assert reproduce(tmp_path, "gpu", "--worlds", "4", "8", "--train-worlds", "6") == 2
    assert "--train-worlds is 6, allowed are those of --worlds: 4 8" in capsys.readouterr().err


def test_thousands_of_worlds_without_a_gpu_are_refused_with_what_to_do(tmp_path, capsys):
    assert reproduce(tmp_path, "gpu") == 2
    said = capsys.readouterr().err
    assert "JAX finds no GPU here" in said and "--worlds 64" in said


def test_worlds_that_are_repeated_have_numbers_of_their_own(monkeypatch):
    monkeypatch.setattr(gpu, "SAMPLED", 2)
    phase = gpu.last_phase(gpu.Config(), "quadrotor", 5)
    worlds = gpu.repeated_worlds(phase)
    assert worlds.number.tolist() == [0, 1, 2, 3, 4]
    assert (worlds.pos_w[0] == worlds.pos_w[2]).all() and (worlds.pos_w[0] != worlds.pos_w[1]).any()


def test_help_says_which_training_it_is(capsys):
    assert cli.main(["reproduce", "gpu", "--help"]) == 0
    assert "recipe gpu" in capsys.readouterr().out
