"""A vehicle's rate loop and mixer as the documented ones, and the effects that it may have."""

from dataclasses import replace

import numpy as np
import pytest

from eval.effects import EFFECTS, nameable_effects
from eval.quadrotor.plant import make_plant, unpack_command
from eval.quadrotor.stepper import wanted_speed
from suite.blind.continuous.quadrotor import commanded_speeds, quadrotor_of
from tests.support.vehicles import PLAIN, drawn_effects, with_effects


def test_the_controller_is_the_documented_one_with_nominal_constants():
    """Within the rotors' range and beyond it, tests/eval/quadrotor works it by hand."""
    rng = np.random.default_rng(0)
    command = rng.uniform([-5.0, -9.0, -9.0, -9.0], [60.0, 9.0, 9.0, 9.0], (2000, 4))
    command[:1000, 1:] *= 0.1
    rate_b = rng.uniform(-1.0, 1.0, (2000, 3)) * rng.choice([0.3, 3.0], (2000, 1))
    truth = with_effects(
        rate_gain=((0.5, 2.0, 1.5),), mass_offset=(0.05,), inertia_scale=((1.1, 0.9, 1.2),),
        thrust_scale=(0.9,), com_offset=((0.005, -0.01, 0.02),), weak_motor=((1.0, 0.8, 1.0, 1.0),),
    )  # fmt: skip
    nominal, push = quadrotor_of(truth).nominal, 1.6e-6
    here = push * commanded_speeds(nominal, command, rate_b) ** 2
    there = push * wanted_speed(make_plant(truth, 0.002), unpack_command(command), rate_b) ** 2
    np.testing.assert_allclose(here, there, rtol=1e-9, atol=2e-6)
    most = push * 2100.0**2
    free = ((here > 1e-3) & (here < most - 1e-3)).all(axis=1)
    assert here.max() == pytest.approx(most) and 0.1 < free.mean() < 0.9


def test_lag_delay_and_every_effect_of_the_catalogue_have_an_equation_and_another_is_refused():
    assert quadrotor_of(PLAIN)[-3:-1] == (0.0, 0.0)
    late = quadrotor_of(with_effects(motor_lag=(0.04,), command_delay=(0.013,)))
    assert (late.time_constant, late.delay) == (0.04, 0.013)
    drawn = drawn_effects(np.random.default_rng(0)).effects
    assert set(drawn) == set(EFFECTS)
    quadrotor_of(replace(PLAIN, effects={name: drawn[name] for name in nameable_effects()}))
    with pytest.raises(ValueError, match="effects.slung_load: .* no equation for it"):
        quadrotor_of(with_effects(slung_load=(0.05, 0.5)))
    odd = with_effects()
    object.__setattr__(odd, "effects", {"ripple": None})
    with pytest.raises(ValueError, match="effects.ripple: .* no equation for it; allowed: .*gusts"):
        quadrotor_of(odd)
