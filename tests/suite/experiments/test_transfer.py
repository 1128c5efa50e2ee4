"""Judged trials in the trainer's dynamics: the same tracks, by the judge's rules."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import TrialSpec
from policies import shipped
from policies.formats.policy_file import load_policy_checkpoint
from policies.spec import PolicySpec
from suite.common.console import Console
from suite.experiments import transfer
from suite.experiments.study.validation import validation_worlds
from suite.train.config import EpisodeConfig
from suite.train.worlds import sample_worlds
from tests.support.documents import page, reproduce
from tests.support.training import SPEC, fresh_params, straight_worlds
from tracks.families import make_track

TRIALS = [TrialSpec("zigzag", 3, 7), TrialSpec("ellipse", 9, 8)]
SPEED = 6.0
REFERENCE = load_vehicle("reference")


def test_worlds_are_the_judged_tracks_from_their_start():
    spec = PolicySpec(speed_input=True, speed=0.7)
    recipe = transfer.quadrotor_recipe(spec, REFERENCE)
    drawn = sample_worlds(validation_worlds(recipe, 2, 0, 1.0), 0)
    worlds = transfer.judged_worlds(drawn, spec, TRIALS)
    for row, trial in enumerate(TRIALS):
        track = make_track(*trial)
        centers = worlds.scene.gates.center_w[row]
        assert np.allclose(centers, track.scene.gates.center_w, atol=1e-5)
        assert np.allclose(worlds.pos_w[row], track.start_pos_w, atol=1e-6)
        heading = [np.cos(track.start_yaw), np.sin(track.start_yaw), 0.0]
        assert np.allclose(worlds.heading_w[row], heading, atol=1e-6)
    assert not worlds.vel_w.any() and not worlds.target.any() and not worlds.hidden.any()
    assert worlds.wanted == pytest.approx([0.7, 0.7])


@pytest.mark.parametrize("made", transfer.TRAINERS.values())
def test_nothing_is_drawn(made):
    recipe = made(SPEC, REFERENCE)
    drawn = sample_worlds(validation_worlds(recipe, 3, 0, 1.0), 0)
    constants: Any = drawn.constants
    values = [constants] if recipe.quadrotor is None else constants.effects.values()
    for arrays in values:
        for array in arrays:
            assert np.allclose(array, np.asarray(array)[:1], rtol=1e-6), array
    assert (drawn.fov_scale == 1).all()


def test_commands_of_the_point_mass_are_as_late_at_any_rate():
    delays = {}
    for rate in (10.0, 15.0, 30.0):
        recipe = transfer.point_recipe(PolicySpec(rate_hz=rate), REFERENCE)
        delays[rate] = recipe.physics.action_delay[0] / rate
    assert delays == pytest.approx(dict.fromkeys(delays, transfer.DELAY_S))


@pytest.mark.parametrize("made", transfer.TRAINERS.values())
def test_the_eye_is_as_fine_as_in_flight(made):
    spec = replace(SPEC, camera=replace(SPEC.camera, rays=2))
    assert made(spec, REFERENCE).physics.rays == 2


@pytest.mark.parametrize(
    ("made", "up", "wins"),
    [
        (transfer.point_recipe, -1.0, True),
        (transfer.quadrotor_recipe, -1.0, False),
        (transfer.quadrotor_recipe, 1.0, True),
    ],
)
def test_a_quadrotor_that_tips_over_has_failed(made, up, wins, monkeypatch):
    monkeypatch.setattr(transfer, "_up", lambda worlds, *_: jnp.full(len(worlds.target), up))
    recipe = replace(made(SPEC, REFERENCE), episode=EpisodeConfig(gates=2))
    config = validation_worlds(recipe, 2, 9, 0.8)
    coasting = {k: v * (k != "action.weight") for k, v in fresh_params().items()}
    worlds = straight_worlds(sample_worlds(config, 0), SPEED)
    won = transfer.make_judged_flight(config)(coasting, worlds)
    assert won.tolist() == [wins, wins]


def test_the_page_says_where_failures_come_from(sky, monkeypatch, tmp_path):
    asked = []

    def wins(policy, recipe, trials, console):
        asked.append((policy, recipe.quadrotor is None, len(trials)))
        return [recipe.quadrotor is None and trial.track == "zigzag" for trial in trials]

    monkeypatch.setattr(transfer, "trainer_wins", wins)
    args = ["--policy", "racer", "--trials", "2", "--difficulty", "0"]
    assert reproduce(tmp_path, "transfer", *args) == 0
    assert asked == [("racer", True, 6), ("racer", False, 6)]
    text, numbers = page(tmp_path, "transfer")
    # Nothing passes eight gates within the second that trials last here.
    assert "before the judge, where 6 fail: 4 policy, 2 dynamics, 0 simulator." in text
    assert "| racer | zigzag | 2 | 0 | 2 | 0 |" in text
    assert [row["source"] for row in numbers["trials"]["racer"]] == ["dynamics"] * 2 + [
        "policy"
    ] * 4


def test_a_policy_that_is_no_checkpoint_is_refused(sky, tmp_path, capsys):
    assert reproduce(tmp_path, "transfer", "--policy", str(tmp_path / "none.onnx")) == 2
    assert "none.onnx" in capsys.readouterr().err


def test_up_is_that_of_the_bodys_z_axis():
    half, full = np.cos(np.pi / 3), np.sin(np.pi / 3)
    rolled = np.array([[1, 0, 0], [0, half, -full], [0, full, half]])
    upside_down = np.diag([1.0, -1.0, -1.0])
    nothing: Any = None
    state: Any = SimpleNamespace(rot_w=jnp.asarray(np.stack([rolled, upside_down])))
    up = transfer._up(nothing, nothing, state, nothing)
    assert up.tolist() == pytest.approx([0.5, -1.0])


def test_batches_are_flown_in_the_order_of_the_trials(monkeypatch):
    """Whoever starts on the left has won, in the stand-in; parameters are the policy's own.

    The last batch is short of trials.
    """
    seen = []

    def made(config):
        assert config.episode.steps == 20 * config.spec.rate_hz and config.episode.batch == 3

        def fly(params, worlds):
            seen.append(params)
            return worlds.pos_w[:, 1] > 0

        return fly

    monkeypatch.setattr(transfer, "make_judged_flight", made)
    monkeypatch.setattr(transfer, "AT_ONCE", 3)
    trials = [TrialSpec(track, 5, seed) for track in ("zigzag", "circular") for seed in (3, 4)]
    recipe = transfer.point_recipe(load_policy_checkpoint(shipped.folder("racer")).spec, REFERENCE)
    won = transfer.trainer_wins("racer", recipe, trials, Console())
    assert won == [make_track(*trial).start_pos_w[1] > 0 for trial in trials]
    assert len(seen) == 2 and set(seen[0]) == set(fresh_params())
