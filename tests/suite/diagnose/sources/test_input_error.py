"""Errors of rollouts by commands that a log lacks, on made linearisations."""

from types import SimpleNamespace

import numpy as np
import pytest

from suite.diagnose.data.noise import Linearisation
from suite.diagnose.data.windows import CHANNELS, KNOTS, STATE
from suite.diagnose.sources.input_error import (
    WIDE,
    Share,
    share_between,
    unknown_commands,
    with_input_error,
)
from suite.diagnose.thresholds import THRESHOLDS

WINDOWS, ROWS, STARTS = 12, 40, STATE + 4
NOISE = 0.1


class Windows(SimpleNamespace):
    def _replace(self, **fields):
        return Windows(**{**vars(self), **fields})


def linearisation(rng, parameters):
    """Return a linearisation whose residual is noise, with random slopes."""
    shape = (WINDOWS, ROWS, CHANNELS)
    windows = Windows(
        row_s=np.tile(np.linspace(0.0, 1.0, ROWS), (WINDOWS, 1)), valid=np.ones(shape, bool),
        flight=np.zeros(WINDOWS, int), start_s=np.arange(WINDOWS, dtype=float),
        start_rotor_error=np.ones(WINDOWS), rotor_valid=np.ones((*shape[:2], 4), bool),
        input_error=None,
    )  # fmt: skip
    slope = rng.standard_normal((*shape, parameters + STARTS))
    residual = NOISE * rng.standard_normal(shape)
    return Linearisation(residual, slope, np.zeros((WINDOWS, STARTS)), windows)


def slow_push(rng, axes):
    """Return slopes along a push that changes slowly, and what one along some axes changes."""
    course = rng.standard_normal((WINDOWS, CHANNELS, KNOTS, 6, 4))
    slope = np.einsum("wckjp,np->wnckj", course, np.linspace(0, 1, ROWS)[:, None] ** range(4))
    values = np.zeros((WINDOWS, KNOTS, 6))
    values[..., axes] = 0.05 * rng.standard_normal(values[..., axes].shape)
    return slope, np.einsum("wnckj,wkj->wnc", slope, values)


@pytest.mark.parametrize(("share", "axes"), [(0.0, 3), (0.4, 3), (0.4, 6), (1.0, 6)])
def test_the_share_of_commands_between_rows_is_fitted_next_to_what_resembles_it(share, axes):
    covered = []
    for seed in range(20):
        rng = np.random.default_rng([4, seed])
        linear = linearisation(rng, parameters=3)
        # The first parameter acts like the commands in between, apart from 0.3 of it.
        difference = -0.1 * (
            linear.slope[..., 0] + 0.3 * rng.standard_normal(linear.residual.shape)
        )
        effect = 0.05 * linear.slope[..., 0]
        # A slow force that no parameter describes, or a torque, too; commands also change these.
        push, other = slow_push(rng, slice(axes))
        difference = difference + other
        residual = linear.residual - share * difference + effect + other
        linear = linear._replace(residual=residual)
        found = share_between(linear, difference, push, THRESHOLDS)
        assert 0.0 < found.error < 0.17
        covered.append(abs(found.value - share) < 3.0 * found.error)
    assert sum(covered) >= 19


def test_where_fast_changes_are_within_the_noise_slow_torques_show_the_share():
    rng = np.random.default_rng(7)
    linear = linearisation(rng, parameters=1)
    push, torque = slow_push(rng, slice(3, 6))
    difference = torque + 0.001 * rng.standard_normal(torque.shape)
    linear = linear._replace(residual=linear.residual - 0.6 * difference)
    found = share_between(linear, difference, push, THRESHOLDS)
    assert found.error < 0.05 and abs(found.value - 0.6) < 3.0 * found.error


def test_a_misfit_widens_the_interval_of_the_share():
    rng = np.random.default_rng(5)
    linear = linearisation(rng, parameters=2)
    linear.slope[..., -STARTS:] = 0.0  # start numbers explain nothing
    difference = 0.1 * rng.standard_normal(linear.residual.shape)
    time_s = linear.windows.row_s[..., None]
    drift = linear._replace(residual=linear.residual + 5.0 * time_s**2)
    push = np.zeros((*difference.shape, KNOTS, 6))
    known, unclear = (share_between(one, difference, push, THRESHOLDS) for one in (linear, drift))
    assert unclear.error > 3.0 * known.error


def test_logs_lack_commands_or_have_all_if_the_share_is_certain():
    cases = {
        Share(0.0, 0.03): (False, True), Share(0.25, 0.14): (False, False),
        Share(0.6, 0.02): (True, False), Share(0.15, 0.057): (False, True),
    }  # fmt: skip
    for share, expected in cases.items():
        assert (share.are_lacking(THRESHOLDS), share.are_complete(THRESHOLDS)) == expected, share


def test_the_error_of_unknown_commands_is_that_of_the_thrust_and_torque_which_they_gave():
    rng = np.random.default_rng(6)
    linear = linearisation(rng, parameters=0)
    push = rng.standard_normal((*linear.residual.shape, KNOTS, 4))
    sizes = np.array([0.5, 5.0, 5.0, 2.0])
    values = sizes * rng.standard_normal((WINDOWS, KNOTS, 4))
    difference = np.einsum("wnckj,wkj->wnc", push, values)
    fast = 0.3 * rng.standard_normal(difference.shape)
    fast[0] = np.nan  # a window that diverges
    error, limits = unknown_commands(linear, push, difference + fast, THRESHOLDS)
    np.testing.assert_allclose(np.sqrt((error[1:] ** 2).mean(axis=0)), sizes, rtol=0.2)
    # What is faster than the knots is noise.
    np.testing.assert_allclose(limits.least_noise, 0.3, rtol=0.3)
    known = with_input_error(linear.windows, push, sizes)
    columns = known.input_error
    np.testing.assert_allclose(columns[..., 5], 5.0 * push[..., 1, 1])
    # Further errors come on top of known ones, such as those of uncertain times.
    both = with_input_error(known, push[..., :3], WIDE).input_error
    np.testing.assert_array_equal(both[..., : columns.shape[-1]], columns)
    np.testing.assert_allclose(both[..., -1], WIDE * push[..., -1, 2])
    assert (error < WIDE).all()
