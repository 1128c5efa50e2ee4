"""Training runs by name."""

from dataclasses import replace

import pytest

from suite.train import losses
from suite.train.config import check
from suite.train.presets import at_rate, chosen_model, preset


def test_a_model_is_asked_for_by_name_or_the_recipes_own():
    swift = preset("swift")
    quad = chosen_model(swift, "quad", "racer5")
    assert quad.quadrotor is not None and quad.quadrotor.vehicle.name == "racer5"
    assert chosen_model(quad, "point", None) == swift == chosen_model(swift, None, None)
    with pytest.raises(ValueError, match="the point mass has none: add --model quad"):
        chosen_model(swift, None, "reference")


def test_swift_quad_varies_its_quadrotors_widely_around_any_vehicle_that_is_asked_for():
    own = preset("swift-quad")
    check(own)
    assert own.quadrotor is not None and own.quadrotor.vehicle.name == "racer5"
    other = chosen_model(own, "quad", "crazyflie21").quadrotor
    assert other is not None and other.vehicle.name == "crazyflie21"
    # What is a torque or a length goes with the vehicle's, all else is the recipe's.
    small, racer = other.vehicle.inertia, own.quadrotor.vehicle.inertia
    share = (small[0] + small[1]) / (racer[0] + racer[1])
    assert other.trim_std == pytest.approx(share * own.quadrotor.trim_std) and share < 0.01
    assert 0.2 < other.com_std_m / own.quadrotor.com_std_m < 0.5
    sizes = {"trim_std": own.quadrotor.trim_std, "com_std_m": own.quadrotor.com_std_m}
    assert replace(other, vehicle=own.quadrotor.vehicle, **sizes) == own.quadrotor
    again = chosen_model(own, "quad", "racer5")
    assert again == own, "to the bit"
    assert chosen_model(own, "point", None).quadrotor is None


def test_each_swift_recipe_changes_what_it_says_of_the_one_before():
    names = ("swift-quad", "swift-30", "swift-ahead", "swift-sure", "swift-keen")
    slow, fast, ahead, sure, keen = map(preset, names)
    assert fast.spec == replace(slow.spec, rate_hz=30.0)
    assert slow.episode.steps / 15.0 == fast.episode.steps / 30.0
    optimizer = replace(fast.optimizer, iterations=ahead.optimizer.iterations)
    spec = replace(fast.spec, second_axis=True)
    assert ahead == replace(fast, spec=spec, optimizer=optimizer)
    assert (sure.spec, sure.quadrotor) == (ahead.spec, ahead.quadrotor)
    assert sure.loss.gradient_decay > ahead.loss.gradient_decay
    camera = replace(sure.spec.camera, rays=2)
    assert keen == replace(sure, spec=replace(sure.spec, camera=camera))


def test_another_rate_keeps_rollouts_and_delays_in_seconds():
    slow = preset("swift-quad")
    fast = at_rate(slow, 30.0)
    check(fast)
    assert (fast.episode.steps, fast.episode.image_stride) == (180, 6)
    assert fast.physics.action_delay == (0.0, 2.0), "not 3: the point mass holds no more"
    assert at_rate(fast, 15.0).episode == slow.episode and at_rate(slow, 15.0) == slow
    odd = at_rate(slow, 20.0)
    check(odd)
    assert (odd.episode.steps, odd.episode.image_stride) == (120, 4)
    late = at_rate(preset("paper"), 30.0).physics
    assert (late.state_delay, late.image_delay) == (2, 4)


def test_the_papers_preset_has_the_papers_weights():
    loss = preset("paper").loss
    assert (loss.clearance, loss.collide) == (3.0, 3.0)
    assert (loss.acceleration, loss.jerk, loss.progress) == (1e-2, 1e-3, 0.4)
    assert loss.progress_norm == loss.projection == 0.0
    assert (losses.BARRIER_HEIGHT, losses.BARRIER_SLOPE, losses.FIELD_DECAY) == (2.0, -32.0, 0.3)
