"""The worlds of an iteration follow the settings."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from suite.delta.replay import nominal_model
from suite.train.dynamics.point_mass import PointMassParams
from suite.train.worlds import sample_worlds
from tests.support.training import small_config


def test_gates_heights_follow_the_setting():
    usual, wide = (
        sample_worlds(small_config(batch=16, height_spread=share), 0).scene.gates.center_w[..., 2]
        for share in (1.0, 2.0)
    )
    assert np.ptp(wide, axis=1).mean() > 1.4 * np.ptp(usual, axis=1).mean()


@pytest.mark.parametrize(
    ("share", "least", "most"), [(0.0, 0.0, 0.1), (0.5, 0.35, 0.65), (1.0, 0.9, 1.0)]
)
def test_as_many_have_missed_a_gate_as_are_asked_for(share, least, most):
    config = small_config(batch=80, rest_share=0.0, missed_share=share, start_speed=5.0)
    worlds = sample_worlds(config, 3)
    gates, rows = worlds.scene.gates, np.arange(80)
    turn = gates.rot_w[rows, worlds.target]
    local = np.einsum("bij,bi->bj", turn, worlds.pos_w - gates.center_w[rows, worlds.target])
    beside = np.hypot(local[:, 1], local[:, 2])
    missed = (np.abs(local[:, 0] - 0.25) < 0.96) & (beside > 0.85) & (beside < 1.85)
    assert least <= missed.mean() <= most
    if share == 1.0:
        assert np.all(np.abs(local[:, 0] - 0.25) < 0.96)
        assert np.all(local[:, 2] < 1.81) and np.any(local[:, 2] > 1.0)
        assert np.linalg.norm(worlds.vel_w, axis=-1).max() < 5.0


def test_how_fast_to_fly_is_drawn_where_it_is_an_input_and_moves_nothing_else():
    config = small_config(batch=64)
    asked = replace(config, spec=replace(config.spec, speed_input=True))
    plain, worlds = sample_worlds(config, 2), sample_worlds(asked, 2)
    assert plain.wanted is None and worlds.wanted is not None
    races = worlds.wanted == 1.0
    assert 0.3 < races.mean() < 0.7
    assert worlds.wanted.min() < 0.2 and 0.8 < worlds.wanted[~races].max() < 1.0
    assert np.abs(worlds.wanted[~races].mean() - 0.5) < 0.15
    jax.tree.map(np.testing.assert_array_equal, plain, worlds._replace(wanted=None))


def test_drag_along_the_bodys_z_has_a_range_of_its_own():
    config = small_config()
    plain = sample_worlds(config, 2)
    physics = replace(config.physics, drag_up=(3.0, 4.0))
    changed = sample_worlds(replace(config, physics=physics), 2)
    before, after = (worlds.constants for worlds in (plain, changed))
    assert isinstance(before, PointMassParams) and isinstance(after, PointMassParams)
    across, up = after.drag[:, :2], after.drag[:, 2]
    np.testing.assert_array_equal(across, before.drag[:, :2])
    assert np.all((up >= 3.0) & (up <= 4.0))
    np.testing.assert_array_equal(changed.pos_w, plain.pos_w)
    np.testing.assert_allclose(nominal_model(physics).drag, [0.45, 0.45, 3.5])


def test_worlds_at_rest_stop_early_and_forget_the_others_remember():
    config = small_config(batch=64, steps=30, rest_share=0.5, stop_from=0.33)
    worlds = sample_worlds(config, 0)
    rests = worlds.remembers == 0
    assert 0 < rests.sum() < 64
    assert (worlds.vel_w[rests] == 0).all()
    assert (worlds.stop[~rests] == 30).all()
    assert worlds.stop[rests].min() >= 10
    assert len(np.unique(worlds.stop[rests])) > 5
