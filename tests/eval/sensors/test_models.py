"""Every sensor model: its equation, bounds, finite gradients, equality in NumPy and JAX."""

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval import sensors
from eval.effects.interface import as_arrays
from eval.sensors import SENSORS, view_models
from eval.sensors.gate_map import GATES
from eval.sensors.interface import Draws, Inertial, Moment, markov_step
from eval.sensors.sensors_file import load_sensors, sensor_set
from policies.observation import View
from tests.support.sensor_views import ALONG, CAMERA, DT_S, draws_of, seen_through, view

SENSING = [name for name, sensor in SENSORS.items() if sensor.sense]


def test_a_map_is_turned_and_stretched_about_the_start_and_shifted():
    start, far = view(pos=(1.0, 0.0, 0.0)), view(pos=(3.0, 1.0, 0.0), gate=(5.0, 0.0, 1.0))
    values = {"shift": 0.1, "yaw": math.pi / 4, "scale": 0.25, "turned": 0.0, "moved": 0.0}
    shown = seen_through("gate_map", values, [start, far], {"normal": 2.0})[1]
    # (4, 0, 1) from the start, turned by 90 degrees, times 1.5, and 0.2 along each axis.
    assert shown.gate_w[0] == pytest.approx((1.0 + 0.2, 6.0 + 0.2, 1.5 + 0.2))
    assert shown.axis_w[0] == pytest.approx((0.0, 1.0, 0.0))
    assert np.array_equal(shown.pos_w, far.pos_w)


def test_each_gate_has_moved_by_itself_and_is_so_as_next_and_as_second():
    normal = np.zeros(5 + 4 * GATES)
    normal[5:] = np.arange(4 * GATES)
    shown = [
        seen_through("gate_map", {"moved": 0.1}, [view(number=k)], {"normal": normal})[0]
        for k in (1, 2, 1 + GATES)
    ]
    assert shown[0].gate_w[0] == pytest.approx((4.3, 0.4, 0.5))
    assert shown[0].second_w[0] - (8, 2, 0) == pytest.approx(shown[1].gate_w[0] - (4, 0, 0))
    assert np.array_equal(shown[2].gate_w, shown[0].gate_w)
    last = view()._replace(second_w=view().gate_w)
    alike = seen_through("gate_map", {"moved": 0.1}, [last], {"normal": normal})[0]
    assert np.array_equal(alike.second_w, alike.gate_w)


def test_state_noise_is_a_first_order_process_with_a_bias():
    values = {"position": 0.1, "velocity": 0.5, "velocity_bias": 0.2, "correlation": 0.2}
    rot = Rotation.from_euler("z", [90.0], degrees=True).as_matrix()
    shown = seen_through("state_noise", values, [view(rot=rot)], {"normal": 1.0}, normal=2.0)[0]
    kept = math.exp(-0.5)
    error = kept + 2.0 * math.sqrt(1.0 - kept**2)
    assert shown.pos_w[0] == pytest.approx([0.1 * error] * 3)
    # The bias (0.2, 0.2, 0.2) is in body axes: forward is world y here.
    assert shown.vel_w[0] - (2, 0, 0) == pytest.approx(0.5 * error + np.array([-0.2, 0.2, 0.2]))
    values = {"attitude": 0.1, "attitude_bias": 0.1, "correlation": 0.0}
    tilted = seen_through("state_noise", values, [view()], {"normal": 0.5}, normal=0.3)[0]
    assert Rotation.from_matrix(tilted.rot_w).as_rotvec()[0] == pytest.approx([0.08] * 3)


def test_state_drift_grows_with_the_root_of_the_way_and_of_the_angle():
    views = [view(), view(pos=(4.0, 0.0, 0.0))]
    shown = seen_through("state_drift", {"position": 0.05}, views, normal=1.0)
    assert shown[0].pos_w[0] == pytest.approx([0.0] * 3, abs=1e-5)
    assert shown[1].pos_w[0] == pytest.approx((4.1, 0.1, 0.1), abs=1e-4)
    values = {"scale": 0.1, "flown": 16.0, "yaw": 0.05}
    shown = seen_through("state_drift", values, views, {"normal": 1.0})[1]
    yaw = 0.05 * 4.0
    assert shown.pos_w[0] == pytest.approx((4.4 * math.cos(yaw), 4.4 * math.sin(yaw), 0.0))
    assert shown.vel_w[0] == pytest.approx((2.2 * math.cos(yaw), 2.2 * math.sin(yaw), 0.0))
    rot = Rotation.from_euler("x", [0.1]).as_matrix()
    turned = [view(), view(rot=rot)]
    shown = seen_through("state_drift", {"yaw_turning": 0.2}, turned, normal=1.0)[1]
    about_z = Rotation.from_matrix(shown.rot_w @ rot.swapaxes(-1, -2)).as_rotvec()[0]
    assert about_z == pytest.approx((0.0, 0.0, 0.2 * math.sqrt(0.1)), rel=0.01)


def test_a_measured_state_has_a_size_a_bias_and_two_colours_for_every_axis():
    values = {
        "position_x": 0.1, "position_x_lasts": 0.2, "position_y_bias": 0.3, "velocity_z": 0.5,
        "velocity_z_fast": 0.36, "velocity_z_fast_lasts": 0.0, "velocity_z_lasts": 0.1,
        "velocity_scale": 0.1, "position_drift": 0.05,
    }  # fmt: skip
    trial = {"normal": np.repeat([1.0, 7.0, 2.0], 9)}  # slow, fast and bias at the start
    each = np.repeat([0.5, 3.0, 1.0], [9, 9, 3])  # slow, fast, drift
    views = [view(), view(pos=(4.0, 0.0, 0.0))]
    shown = seen_through("measured_state", values, views, trial, normal=each)
    x, z = (math.exp(-k) + 0.5 * math.sqrt(1.0 - math.exp(-2.0 * k)) for k in (0.5, 1.0))
    assert shown[0].pos_w[0] == pytest.approx((0.1 * x, 0.6, 0.0), abs=1e-4)
    assert shown[0].vel_w[0] == pytest.approx((2.2, 0.0, 0.5 * (0.8 * z + 0.6 * 3.0)))
    assert shown[1].pos_w[0, 1:] == pytest.approx((0.6 + 0.05 * 2.0, 0.05 * 2.0), abs=1e-4)
    values = {"attitude_y": 0.1, "attitude_y_lasts": 0.0, "attitude_y_bias": 0.02}
    tilted = seen_through("measured_state", values, [view()], trial, normal=each)[0]
    about_y = Rotation.from_matrix(tilted.rot_w).as_rotvec()[0]
    assert about_y == pytest.approx((0.0, 0.1 * 0.5 + 0.02 * 2.0, 0.0))


def test_neglected_drag_tilts_the_estimate_against_the_velocity():
    # Flight along world x at 2 m/s, with the nose to world y: the true lean is forward, about +y.
    rot = Rotation.from_euler("z", [90.0], degrees=True).as_matrix()
    still = view(rot=rot)._replace(vel_w=np.zeros((1, 3)))
    values = {"drag": 0.4, "lasts": 0.2}
    shown = seen_through("drag_tilt", values, [still, view(rot=rot), view(rot=rot)])
    off = [Rotation.from_matrix(one.rot_w @ rot.swapaxes(-1, -2)).as_rotvec()[0] for one in shown]
    steady = -0.4 * 2.0 / 9.81
    expected = [steady * (1.0 - math.exp(-0.5 * k)) for k in range(3)]
    assert np.array(off) == pytest.approx(np.array([(0.0, y, 0.0) for y in expected]))
    begun = seen_through("drag_tilt", values, [view()])[0]
    assert Rotation.from_matrix(begun.rot_w).as_rotvec()[0] == pytest.approx((0.0, steady, 0.0))


def test_a_lost_estimate_runs_away_and_jumps_as_it_is_found():
    values = {"share": 0.5, "length": 1.0, "acceleration": 2.0, "jump": 0.3}
    sensor, models = SENSORS["state_loss"], view_models(sensor_set({"state_loss": values}).models)
    memory = sensors.start(models, view(), {"state_loss": draws_of(sensor.trial)}, DT_S, CAMERA)
    errors = []
    for chance in (0.0, 1.0, 0.0, 1.0):  # lost, still lost, found, not lost
        draws = {"state_loss": draws_of(sensor.observation, normal=1.0, uniform=chance)}
        seen, memory = sensors.sense(models, memory, view(), draws, DT_S, CAMERA)
        errors.append((seen.pos_w[0, 0], seen.vel_w[0, 0] - 2.0))
    assert np.array(errors) == pytest.approx(
        np.array([(0.02, 0.2), (0.06, 0.4), (0.3, 0.0), (0.3, 0.0)]), abs=1e-12
    )


def test_corners_noise_becomes_an_error_that_grows_with_the_range():
    values = {"pixels": 2.0, "half_side": 0.5, "known_tilt": 1.0}
    found = {}
    for range_m in (2.0, 4.0):
        truth = view(gate=(range_m, 0.0, 0.0))
        shown = seen_through("gate_detection", values, [truth], normal=1.0)[0]
        found[range_m] = shown.gate_w[0] - truth.gate_w[0]
    # 640 pixels over 90 degrees: f = 320.
    assert found[2.0][1:] == pytest.approx([2.0 * 2 / (math.sqrt(2) * 320)] * 2)
    assert found[2.0][0] == pytest.approx(2.0 * 4 / (math.sqrt(8) * 320 * 0.5))
    assert found[4.0][0] == pytest.approx(4 * found[2.0][0])
    about = Rotation.align_vectors(shown.axis_w, ALONG)[0].magnitude()
    tilt = 2.0 * 16 / (2 * 320 * 0.25)
    assert about == pytest.approx(math.sqrt(2) * tilt / math.sqrt(1 + tilt**2), rel=0.05)


def test_a_gate_that_is_not_found_stays_where_it_was_last_seen():
    start, passed = view(), view(pos=(5.0, 0.0, 0.0), gate=(8.0, 2.0, 0.0), number=1)
    behind = view(pos=(0.0, 0.0, 0.0), gate=(-3.0, 0.0, 0.0))
    models = view_models(sensor_set({"gate_detection": {"pixels": 0.0, "missed": 0.5}}).models)
    sensor, name = SENSORS["gate_detection"], "gate_detection"
    memory = sensors.start(models, start, {name: draws_of(sensor.trial)}, DT_S, CAMERA)

    def see(truth, memory, missed):
        draws = {name: draws_of(sensor.observation, uniform=0.0 if missed else 1.0)}
        return sensors.sense(models, memory, truth, draws, DT_S, CAMERA)

    mapped = start._replace(gate_w=start.gate_w + 1.0, second_w=start.second_w + 1.0)
    look, about = sensor.sense, Moment(start, draws_of(sensor.observation), DT_S, CAMERA)
    # The map is off by a metre and the estimate of the position too: what is seen is relative.
    off = mapped._replace(pos_w=start.pos_w + 1.0)
    seen, memory_off = look(models[name], memory[name], off, about)
    assert seen.gate_w[0] == pytest.approx((5.0, 1.0, 1.0))
    gone = Moment(passed, draws_of(sensor.observation, uniform=0.0), DT_S, CAMERA)
    kept, _ = look(models[name], memory_off, passed._replace(gate_w=passed.gate_w + 9.0), gone)
    assert kept.gate_w[0] == pytest.approx((9.0, 3.0, 1.0)), "the second gate, as it was seen"
    unseen, _ = see(behind, memory, missed=False)
    assert np.array_equal(unseen.gate_w, behind.gate_w), "behind the camera there is the map alone"


def test_an_older_view_is_shown_without_the_estimates_of_later_gates():
    """With delays that vary, a view before a gate may follow one after it."""
    later = view(pos=(4.5, 0.0, 0.0), gate=(8.0, 2.0, 0.0), number=1)
    older = view(pos=(3.9, 0.0, 0.0))  # too near to its gate to see the corners
    shown = seen_through("gate_detection", {"smoothing": 0.1}, [view(), later, older, later])
    for seen, truth in zip(shown, (view(), later, older, later), strict=True):
        assert seen.gate_w[0] == pytest.approx(truth.gate_w[0])


def test_a_gap_in_detections_stays_with_its_gate_when_the_one_before_is_passed():
    values = as_arrays(SENSORS["gate_detection"].values(0.0, 0.5, 10.0, 0.5, 0.1, 0.0))
    sensor = SENSORS["gate_detection"]
    memory = sensor.start(values, Moment(view(), draws_of(sensor.trial), DT_S, CAMERA))
    memory = memory | {"missed": np.array([[False, True]])}
    same = Moment(view(number=1), draws_of(sensor.observation, uniform=0.5), DT_S, CAMERA)
    assert sensor.sense(values, memory, same.truth, same)[1]["missed"].tolist() == [[True, False]]


def test_the_wrong_gate_is_the_second():
    shown = seen_through("wrong_gate", {"share": 0.5}, [view()], uniform=0.0)[0]
    assert np.array_equal(shown.gate_w, view().second_w)
    shown = seen_through("wrong_gate", {"share": 0.5}, [view()], uniform=1.0)[0]
    assert np.array_equal(shown.gate_w, view().gate_w)


def test_blind_and_lost_images():
    views = [view(depth=3.0), view(depth=4.0)]
    for name, first, second in (("exposure", 10.0, 10.0), ("frame_loss", 3.0, 3.0)):
        lost = seen_through(name, {"share": 0.95}, views, uniform=0.5)
        assert (lost[0].depth_m == first).all() and (lost[1].depth_m == second).all(), name
        came = seen_through(name, {"share": 0.5}, views, uniform=1.0)
        assert (came[1].depth_m == 4.0).all(), name
    # A first image that is lost has no image before it: it has the errors of the other models.
    sensor, blind = SENSORS["frame_loss"], view(depth=10.0)
    values = as_arrays(sensor.values(0.95, 0.0))
    first = Moment(view(), draws_of(sensor.observation, uniform=0.5), DT_S, CAMERA)
    memory = sensor.start(values, first)
    assert (sensor.sense(values, memory, blind, first)[0].depth_m == 10.0).all()


def test_turning_moves_an_image_row_by_row_and_blurs_it():
    depth = np.array([2.0] * 4 + [4.0] * 4)
    rot = Rotation.from_euler("z", [0.1]).as_matrix()
    views = [view(depth=depth), view(rot=rot, depth=depth)]
    # 4 pixels a radian (8 over 90 degrees) at 1 rad/s: 1 s of readout moves the first of six rows
    # back by 2 pixels and the middle one not at all.
    values = {"readout": 0.5, "exposure": 0.0}
    shown = seen_through("image_motion", values, views)[1].depth_m[0]
    rate = math.sin(0.1) / 0.1 * 4
    assert shown[3] == pytest.approx(depth)
    moved = np.interp(np.arange(8) + 0.25 * rate, np.arange(8), 1 / depth)
    assert shown[0] == pytest.approx(1 / moved)
    blurred = seen_through("image_motion", {"exposure": 0.5}, views)[1].depth_m[0, 2]
    sides = [np.interp(np.arange(8) + s * 0.25 * rate, np.arange(8), 1 / depth) for s in (-1, 1)]
    assert blurred == pytest.approx(2 / (sides[0] + sides[1]))


def test_an_imu_has_bias_noise_vibration_and_limits():
    values = SENSORS["imu"].values(0.01, 0.1, 0.02, 5.0, 0.03, 0.2, 0.04, 30.0, 0.05, 0.06)
    values, sensor = as_arrays(values), SENSORS["imu"]
    moment = Moment(view(), draws_of(sensor.trial, normal=1.0), 0.01, CAMERA)
    truth = Inertial(np.array([[1.0, 2.0, 9.0]]), np.array([[0.0, 1.0, 10.0]]))
    memory = sensor.start(values, moment)
    draws = draws_of(sensor.observation, normal=1.0)
    found, memory = sensor.measure(values, memory, truth, draws, 0.01)
    gyro = 0.1 + 0.02 * 0.1 + 0.01 / 0.1
    assert found.rate_b[0] == pytest.approx((1.0 + gyro, 2.0 + gyro, 5.0))
    acc = 0.2 + 0.04 * 0.1 + 0.05 * 10 + 0.03 / 0.1 + 0.06 * 10
    assert found.acc_b[0] == pytest.approx((acc, 1.0 + acc, 10.0 + acc))
    assert memory["gyro"][0] == pytest.approx([0.102] * 3)


@pytest.mark.parametrize(("share", "length"), [(0.3, 0.5), (0.3, 0.0), (0.95, 0.05)])
def test_a_fault_is_there_for_its_share_and_lasts_its_length(share, length):
    draws = np.random.default_rng(0).random((4000, 50))
    on, found = np.zeros(50, bool), []
    for chance in draws:
        on = markov_step(on, chance, np.array(share), np.array(length), DT_S)
        found.append(on)
    found = np.array(found)
    assert found.mean() == pytest.approx(share, abs=0.02)
    ends = (found[:-1] & ~found[1:]).sum() / found[:-1].sum()
    assert ends == pytest.approx(min(DT_S / max(length, 1e-9), 1 - share), rel=0.05)


def many_views(count, rng):
    """Return a flight of views with 3 rows, of random places, attitudes and images."""
    place = rng.uniform(-5.0, 5.0, (5, 3, 3))
    rot = Rotation.random(3, rng).as_matrix()
    for k in range(count):
        turn = Rotation.from_euler("xyz", [[0.05 * k, 0.02, 0.1 * k]] * 3).as_matrix()
        depth_m = rng.uniform(0.05, 10.0, (3, 6, 8))
        yield View(
            place[0] + 0.3 * k, rot @ turn, place[1], place[2], place[3], rot[..., 0], rot[..., 1],
            depth_m, np.array([0, k // 2, 5]),
        )  # fmt: skip


def random_draws(needs, rng):
    normal, grain = (rng.standard_normal((3, *s)) for s in ((needs.normal,), (needs.grain, 6, 8)))
    return Draws(normal, rng.random((3, needs.uniform)), grain, rng.random((3, needs.chance, 6, 8)))


def highest(name):
    values = {p.name: p.high for p in SENSORS[name].parameters if p.name in SENSORS[name].grows}
    return sensor_set({name: values}).models[name]


def usual(name):
    return next(
        load_sensors(source).models[name]
        for source in ("all", "tof-depth", "nanobench")
        if name in load_sensors(source).models
    )


def through(name, values, views, first, each):
    """Return the last view of a flight through a model."""
    memory = sensors.start({name: values}, views[0], {name: first}, DT_S, CAMERA)
    for one, draws in zip(views, each, strict=True):
        seen, memory = sensors.sense({name: values}, memory, one, {name: draws}, DT_S, CAMERA)
    return seen


through_by_jax = jax.jit(through, static_argnums=0)


@pytest.mark.parametrize("name", SENSING)
def test_a_model_stays_within_bounds_and_is_alike_in_numpy_and_jax(name):
    rng, sensor = np.random.default_rng(3), SENSORS[name]
    views, first = list(many_views(5, rng)), random_draws(sensor.trial, rng)
    each = [random_draws(sensor.observation, rng) for _ in views]
    for strength in (usual, highest):
        flight = name, as_arrays(strength(name)), views, first, each
        seen = through(*flight)
        assert all(np.isfinite(part).all() for part in seen)
        assert (seen.depth_m > 0.0).all() and (seen.depth_m <= CAMERA.range_m * (1 + 1e-9)).all()
        assert np.linalg.det(seen.rot_w) == pytest.approx(np.ones(3))
        with jax.enable_x64(True):
            again = through_by_jax(*flight)
        for field, one, two in zip(View._fields, seen, again, strict=True):
            assert np.asarray(two) == pytest.approx(one, rel=1e-9, abs=1e-9), field


@pytest.mark.parametrize("name", SENSING)
def test_gradients_through_state_and_gates_are_finite_and_not_cut(name):
    sensor, rng = SENSORS[name], np.random.default_rng(3)
    first, each = (random_draws(need, rng) for need in (sensor.trial, sensor.observation))
    truth = jax.tree.map(jnp.asarray, next(many_views(1, rng)))

    @jax.jit
    @partial(jax.grad, argnums=(0, 1, 2))
    def gradient(pos_w, rot_w, vel_w, moving):
        here = truth._replace(pos_w=pos_w, rot_w=rot_w, vel_w=vel_w)
        views = [here._replace(pos_w=pos_w + moving * k * vel_w * DT_S) for k in range(3)]
        seen = through(name, as_arrays(usual(name)), views, first, [each] * 3)
        parts = seen._replace(depth_m=0.0, gate_number=0)
        return sum(jnp.sum(part) for part in parts)

    for moving in (0.0, 1.0):
        found = gradient(truth.pos_w, truth.rot_w, truth.vel_w, moving)
        # Position, attitude and velocity each reach what is sensed.
        assert all(np.isfinite(part).all() and 0.5 < np.abs(part).max() < 1e3 for part in found)
