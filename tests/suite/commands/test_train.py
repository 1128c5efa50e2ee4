"""The options of the train command become a run's settings."""

import shutil
from dataclasses import replace

import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from policies import shipped
from suite import cli
from suite.commands.train import Config, resolve
from suite.judging.flying import checkpoint_folder
from suite.train import run


def test_options_become_settings():
    config = resolve(Config(recipe="quick", seed=4, iterations=7, set=("optimizer.rate=1",)))
    assert (config.seed, config.optimizer.iterations, config.optimizer.rate) == (4, 7, 1.0)
    with pytest.raises(ValueError, match="Did you mean 'race'"):
        resolve(Config(recipe="rcaer"))


def test_training_goes_on_from_a_shipped_policy_by_its_name(tmp_path, capsys):
    assert checkpoint_folder("race-paper", "--init-from") == shipped.folder("race-paper")
    assert cli.main(["train", "--init-from", "rac", "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err
    assert "--init-from rac: " in said and "a shipped policy's name (race, race-paper" in said
    assert not (tmp_path / "run").exists()


def test_the_policy_that_is_trained_on_is_not_written_over(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(run, "train", None)
    own = shutil.copytree(shipped.folder("race-paper"), tmp_path / "policy")
    assert cli.main(["train", "--init-from", str(own), "--out", str(tmp_path)]) == 2
    assert "config.json is also an input and would be overwritten" in capsys.readouterr().err


def test_the_command_line_asks_for_model_and_vehicle_together():
    reference = load_vehicle("reference")
    config = resolve(Config(model="quad", vehicle="reference"))
    assert config.quadrotor is not None and config.quadrotor.vehicle == reference
    changed = resolve(Config(model="quad", vehicle="racer5", set=("quadrotor.physics_hz=500",)))
    assert changed.quadrotor is not None and changed.quadrotor.physics_hz == 500.0
    own = resolve(Config()).quadrotor
    assert own is not None and own.vehicle != reference, "by default it has not seen the tables'"
    assert resolve(Config(recipe="race-paper")).quadrotor is None
    with pytest.raises(ValueError, match="--model quad needs --vehicle.*reference"):
        resolve(Config(model="quad"))
    around = resolve(Config(vehicle="reference")).quadrotor
    assert around == replace(own, vehicle=reference), "the recipe's own spreads"
    with pytest.raises(ValueError, match="--vehicle is racer5.*point mass has none.*--model quad"):
        resolve(Config(recipe="race-paper", vehicle="racer5"))
    with pytest.raises(ValueError, match="Did you mean 'racer5'"):
        resolve(Config(model="quad", vehicle="racer6"))
