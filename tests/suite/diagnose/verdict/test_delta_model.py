"""The black box in the diagnosed quadrotor: its output acts on the body, and it learns."""

import jax
import numpy as np
import pytest

from suite.diagnose.data.colour import Noise
from suite.diagnose.data.windows import CHANNELS, KNOTS, cut, take
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.rollouts import BATCH, RolloutModel
from suite.diagnose.verdict.black_box import (
    BlackBoxConfig,
    _initial_weights,
    black_box_gap,
    compare_black_box,
)
from suite.diagnose.verdict.rollout_gap import true_starts
from tests.support.diagnosis_flights import NOISE, fly
from tests.support.vehicles import PLAIN, with_effects, with_lag

LAGGED = with_lag(PLAIN, 0.03)
TRUTH = with_effects(LAGGED, linear_drag=((0.15, 0.15, 0.05),))
WHITE = Noise(
    np.repeat(
        [NOISE["pos"], NOISE["att"], NOISE["vel"], NOISE["rate"], np.nan],
        [3, 3, 3, 3, CHANNELS - 12],
    ),
    {},
)


@pytest.mark.slow
def test_under_measured_rotors_what_stands_for_the_commands_does_not_count():
    windows, _ = cut([fly(TRUTH, 0, duration_s=7.0, motors=True)], LAGGED, True, 0.5)
    assert windows is not None and np.asarray(windows.rotor_speed).any()
    windows = take(windows, np.arange(BATCH))
    model = RolloutModel(LAGGED, make_space(LAGGED), True, False)
    params = {name: np.asarray(value) for name, value in _initial_weights(0).items()}
    shape = params["output.weight"].shape
    params["output.weight"] = 0.1 * np.random.default_rng(0).normal(size=shape)
    other = windows._replace(command=np.full_like(windows.command, 3.0))
    gaps = [black_box_gap(model, params, each, WHITE).score for each in (windows, other)]
    np.testing.assert_allclose(*gaps, rtol=1e-9)


def test_its_output_pushes_the_body():
    jax.config.update("jax_disable_most_optimizations", True)  # each program runs once
    windows, _ = cut([fly(TRUTH, 0, duration_s=7.0)], LAGGED, False, 0.5)
    assert windows is not None and len(windows.flight) >= BATCH
    windows = take(windows, np.arange(BATCH))
    model = RolloutModel(LAGGED, make_space(LAGGED), False, False)
    theta = model.space.array("start")
    push = np.array([0.3, -0.2, 0.5, 0.0, 0.0, 0.0])
    params = {name: np.asarray(value) for name, value in _initial_weights(0).items()}
    params["output.bias"] = push
    offset = true_starts(model, theta, windows)
    same = np.broadcast_to(push, (BATCH, KNOTS, 6))
    with jax.enable_x64(True):
        apart = np.asarray(jax.jit(model.fly)(theta, offset, windows, same)[0])
    boxed = black_box_gap(model, params, windows, WHITE)
    at = np.abs(np.asarray(windows.row_s) - 1.0).argmin(axis=1)
    error = apart[np.arange(BATCH), at][:, :3]
    rms = np.sqrt((error**2).sum(axis=1).mean())
    assert boxed.channels["1 s"]["position"].error == pytest.approx(rms, rel=1e-6)


@pytest.mark.slow
def test_it_learns_and_the_named_effect_holds_up_better_outside():
    logs = [fly(TRUTH, k, duration_s=8.0, speed=3.0 + k) for k in range(5)]
    result = diagnose(logs, LAGGED)
    found = compare_black_box(
        result.main.source.rollouts, result.main, BlackBoxConfig(iterations=200)
    )
    inside, outside = found.held_out, found.outside
    assert outside is not None and inside.named is not None and outside.named is not None
    assert inside.black_box.rms < 0.5 * inside.before.rms
    assert outside.named.rms < 1.3 < outside.black_box.rms
    assert outside.judged >= 6 and outside.fitted >= 6
