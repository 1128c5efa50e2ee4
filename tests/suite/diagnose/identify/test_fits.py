"""The fit, and what is fitted: force, torque, the nominal rate loop, the torque of moving air."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from suite.diagnose.identify import body, drive, flapping, loop
from suite.diagnose.identify.fit import KnownNumbers, NoWholeWindow, Rows, Unknown, fit
from suite.diagnose.identify.grid import LEANING, ROTOR_NOISE, STEP_S, FlightGrid
from tests.support import identified as known
from tests.support import real_flights
from tests.support.vehicles import PLAIN

pytestmark = pytest.mark.usefixtures("compiled_quickly")
SLOPE = Unknown("slope", 0.0, -10.0, 10.0, 1.0, 1e-3)
BLIND = Unknown("blind", 4.0, -10.0, 10.0, 1.0, 1e-3)
NONE = np.array([False])


def flights(slopes, noise=0.1, count=200, seed=0):
    """Residual functions of `y = slope x + noise`, one flight a slope."""
    rng = np.random.default_rng(seed)
    made = []
    for slope in slopes:
        x = rng.normal(size=count)
        made.append((x, slope * x + noise * rng.normal(size=count), np.arange(count) // 10))

    def residuals(numbers):
        slope = numbers["slope"]
        return [Rows((y - slope * x)[:, None], block, NONE) for x, y, block in made]

    return residuals


def test_a_number_that_nothing_hangs_on_stays_and_flights_that_differ_are_the_units():
    found = fit(flights([2.0] * 4), [SLOPE, BLIND])
    assert found.not_identified == ("blind",)
    assert found.value[1] == 4.0 and np.isnan(found.half_width[1])
    assert abs(found.value[0] - 2.0) < 0.02
    alike, apart = (
        fit(flights(slopes), [SLOPE]) for slopes in ([2.0] * 5, [1.8, 1.9, 2.0, 2.1, 2.2])
    )
    assert max(5.0 * alike.half_width[0], abs(apart.value[0] - 2.0)) < apart.half_width[0]


def test_intervals_hold_the_truth_nineteen_times_in_twenty():
    found = [fit(flights([2.0] * 4, count=100, seed=k), [SLOPE]) for k in range(60)]
    inside = [abs(one.value[0] - 2.0) < one.half_width[0] for one in found]
    assert 0.90 <= np.mean(inside) <= 0.99 and max(one.half_width[0] for one in found) < 0.03


def test_nuisance_parameters_weigh_as_in_generalised_least_squares():
    rng, count, noise = np.random.default_rng(0), 40, 0.5
    x, y = rng.normal(size=(2, count))
    nuisance = rng.normal(size=(count, 1, 3))

    def residuals(numbers):
        return [Rows((y - numbers["slope"] * x)[:, None], np.arange(count), NONE, nuisance)]

    found = fit(residuals, [SLOPE], noise=np.array([noise]))
    covariance = noise**2 * np.eye(count) + nuisance[:, 0] @ nuisance[:, 0].T
    weighted = np.linalg.solve(covariance, x)
    assert found.value[0] == pytest.approx(weighted @ y / (weighted @ x), rel=1e-6)


def test_what_is_known_widens_what_depends_on_it():
    """`y = (slope + other) x`: the slope is off by as much as the other, and by no less."""
    residuals = flights([2.0] * 4)

    def both(numbers):
        return residuals({"slope": numbers["slope"] + numbers["other"]})

    known = KnownNumbers(("other",), np.array([[0.1**2]]))
    found = fit(both, [SLOPE, Unknown("other", 0.5, -9.0, 9.0, 1.0, 1e-3)], known=known)
    alone = fit(residuals, [SLOPE])
    np.testing.assert_allclose(found.value, [1.5, 0.5], atol=0.02)
    wanted = np.hypot(alone.half_width[0], 1.96 * 0.1)
    np.testing.assert_allclose(found.half_width[0], wanted, rtol=1e-6)
    assert np.isnan(found.half_width[1]) and not found.identifies("other")
    assert found.not_identified == ()
    np.testing.assert_allclose(found.known_numbers("other", "none").covariance, [[0.01]])


def test_the_methods_own_errors_do_not_cancel_in_a_sum():
    rng, made = np.random.default_rng(0), []
    for _ in range(4):
        x = rng.normal(size=200)
        near = x + 0.2 * rng.normal(size=200)
        made.append((x, near, 2.0 * x - 1.0 * near + 0.01 * rng.normal(size=200)))
    block = np.arange(200) // 10

    def residuals(numbers):
        slope, other = numbers["slope"], numbers["other"]
        return [Rows((y - slope * x - other * n)[:, None], block, NONE) for x, n, y in made]

    numbers = [SLOPE._replace(method_error=0.5), Unknown("other", 0.0, -9.0, 9.0, 1.0, 1e-3, 0.5)]
    found = fit(residuals, numbers)
    both = found.covariance
    assert both[0, 1] < 0.0 and np.sqrt(both[0, 0]) == pytest.approx(0.5 / 1.96, rel=0.01)
    assert np.sqrt(both.sum()) == pytest.approx(np.sqrt(2.0) * 0.5 / 1.96, rel=0.01)


def test_intervals_of_few_blocks_are_as_much_wider_as_students_t():
    few, many = (
        [fit(flights([2.0], count=count, seed=k), [SLOPE]).half_width[0] for k in range(20)]
        for count in (40, 2000)
    )
    # 4 blocks of 10 rows: t(3) = 3.18 in place of 1.96; the jackknife itself is a bit wider still.
    ratio = np.sqrt(np.mean(np.square(few)) * 40) / np.sqrt(np.mean(np.square(many)) * 2000)
    assert 1.6 < ratio < 3.0


@pytest.mark.parametrize("noise", [None, np.array([0.1])])
def test_what_one_block_alone_shows_is_not_identified(noise):
    """The fit follows that block, so that its residual, and with it the spread, is zero."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        block = np.arange(70) // 14
        x = rng.normal(size=70) * (block == 0)
        y = 2.0 * x + 0.1 * rng.normal(size=70)

        def residuals(numbers, x=x, y=y, block=block):
            return [Rows((y - numbers["slope"] * x)[:, None], block, NONE)]

        assert fit(residuals, [SLOPE], noise=noise).not_identified == ("slope",)


def test_missing_values_are_left_out_and_a_fit_without_rows_is_refused():
    with pytest.raises(NoWholeWindow):
        fit(flights([2.0], count=0), [SLOPE])

    def with_holes(numbers):
        rows = flights([2.0] * 4)(numbers)
        for one in rows:
            one.value[::3] = np.nan
        return rows

    found = fit(with_holes, [SLOPE])
    assert abs(found.value[0] - 2.0) < found.half_width[0] < 0.03


LAGS = {"lag": 0.0, "late": 0.0}


def test_the_thrust_is_what_path_and_gravity_need_in_fast_windows_with_an_attitude_alone():
    """Of a flight that accelerates by 2 m/s^2 along x, its rotors at 1000 rad/s."""
    time_s, felt = STEP_S * np.arange(500), np.hypot(9.81, 2.0)
    turn = Rotation.from_euler("y", np.arctan2(2.0, 9.81)).as_matrix()
    rot_w, driven = np.broadcast_to(turn, (500, 3, 3)), drive.DrivenVehicle(PLAIN, "rotors")

    def fitted(name, speed=0.0):
        vel_w = np.outer(time_s, [2.0, 0.0, 0.0]) + [speed - 1.0, 0.0, 0.0]
        signals = {"vel_w": vel_w, "rotor_speed": np.full((500, 4), 1000.0), name: rot_w}
        unknowns = body.force_unknowns(driven, False, leaning=name == LEANING)[:1]
        return body.fit_force(unknowns, [FlightGrid("made", time_s, signals)], driven, LAGS)

    by_rotors = 4e6 * PLAIN.rotors.thrust_coefficient / PLAIN.mass
    for name in ("rot_w", LEANING):
        np.testing.assert_allclose(np.exp(fitted(name).value[0]), felt / by_rotors, rtol=1e-6)
    with pytest.raises(NoWholeWindow):
        fitted(LEANING, speed=6.0)


def rolled(noise, **limits):
    """Return the fit of twice the inertia about x to rotor speeds with noise."""
    rng, count = np.random.default_rng(0), 5000
    swing = np.convolve(rng.standard_normal(count), np.hanning(25), "same") / 3.0
    true = 1100.0 + 40.0 * swing[:, None] * np.sign(np.asarray(PLAIN.rotors.position)[:, 1])
    grid = FlightGrid("made", STEP_S * np.arange(count), {"rotor_speed": true})
    true_inertia = (2.0 * PLAIN.inertia[0], *PLAIN.inertia[1:])
    driven = drive.DrivenVehicle(replace(PLAIN, inertia=true_inertia), "rotors")
    _, turn_b = driven.accelerations(LAGS)(grid, grid.rows(False))
    rate_b = STEP_S * (np.cumsum(turn_b, axis=0) - 0.5 * turn_b)
    drawn = noise * rng.standard_normal((2, count, 4))
    signals = {"rotor_speed": true + drawn[0], ROTOR_NOISE: drawn[1], "rate_b": rate_b}
    unknowns = [body.torque_unknowns("rotors", 0.0, 0.0)[0]._replace(**limits)]
    grid = grid._replace(signals=signals)
    return body.fit_torque(unknowns, [grid], drive.DrivenVehicle(PLAIN, "rotors"), LAGS)


def test_noise_of_the_rotor_speeds_widens_the_interval_and_makes_no_body_heavier():
    """At 100 rad/s 15 % of the variance is noise, by which the inertia would seem larger."""
    for noise, half in ((0.0, 0.015), (100.0, 0.16)):
        found = rolled(noise)
        assert found.identifies("inertia_x") and abs(found.value[0] - np.log(2.0)) < 0.02
        assert found.half_width[0] == pytest.approx(half, rel=0.1)
    # What is mostly noise, or at its limit, is not identified.
    assert not rolled(300.0).identifies("inertia_x")
    assert not rolled(0.0, high=0.3).identifies("inertia_x")


@pytest.mark.extended
def test_flapping_is_within_its_interval_and_none_without_what_it_needs():
    true, flights = 4e-7, real_flights.flights
    blown = flights(3, 5, 4.0, blade_flapping=(true,))
    entry = flapping.flapping_of(blown, real_flights.VEHICLE)
    assert entry is not None and entry.key == "effects.blade_flapping.coefficient"
    ((low, high),), (value,) = entry.ci95, entry.value
    assert value == pytest.approx(true, rel=0.1)
    assert low - 0.5 * (high - low) < true < high + 0.5 * (high - low)
    level = [replace(log, quat_wxyz=np.full_like(log.quat_wxyz, np.nan)) for log in blown]
    hover = np.full(len(blown[0].time_s), 9.81)
    bare = [replace(log, rotor_speed=None, thrust_cmd=hover) for log in blown]
    without = flights(3, 6, 2.0)
    for logs in (level, bare, without):
        assert flapping.flapping_of(logs, real_flights.VEHICLE) is None


def test_motors_are_off_by_their_covariance_and_inertia_by_its_own():
    start, covariance = known.start(), [[4e-4, 0, -1e-4], [0, 0.1, 0], [-1e-4, 0, 9e-4]]
    force = known.fitted(("thrust", "drag_x", "curve"), covariance)
    torque = known.fitted(("inertia_x", "inertia_y"), np.diag([0.01, 0.0004]))
    driven = drive.DrivenVehicle(start, "pwm", usual_command=0.5, usual_volts=15.0)
    found = flapping.perturbed_vehicles(start, driven, force, torque)
    assert len(found) == 4
    hover = [v.motors.thrust[0] * 0.5 + v.motors.thrust[1] * 0.25 for v in found[:2] if v.motors]
    off = np.log(np.array(hover) / sum(driven.usual_thrust))
    np.testing.assert_allclose(np.linalg.norm(off), 0.02, rtol=0.05)
    off = np.log([np.asarray(v.inertia) / start.inertia for v in found[2:]])
    np.testing.assert_allclose(np.linalg.norm(off, axis=0)[:2], [0.1, 0.02], rtol=1e-6)
    assert all(v.motors == start.motors for v in found[2:])


BARE = FlightGrid("made", np.zeros(0), {})
COUPLED = {unknown.name: unknown.start for unknown in loop.loop_unknowns(PLAIN, [BARE])}


def test_the_loop_follows_its_equations_integrated_by_another_method():
    """Against `J dw/dt = t - w x J w`, `lag dt/dt + t = J K (cmd - w) + w x J w`, integrated."""
    lag_s, inertia = 0.04, np.asarray(PLAIN.inertia)
    gain = np.asarray(PLAIN.controller.rate_gain)
    fast = replace(PLAIN, controller=replace(PLAIN.controller, frequency=10_000.0))

    def wanted(t):
        return np.array([3.0 * np.sin(4.0 * t), 3.0 * np.cos(3.0 * t), 2.0])

    def slope(t, state):
        rate, torque = state[:3], state[3:]
        gyro = np.cross(rate, inertia * rate)
        asked = inertia * gain * (wanted(t) - rate) + gyro
        return np.concatenate([(torque - gyro) / inertia, (asked - torque) / lag_s])

    time_s = STEP_S * np.arange(500)
    exact = solve_ivp(slope, (0.0, time_s[-1]), np.zeros(6), t_eval=time_s, rtol=1e-8).y[:3].T
    command = np.stack([wanted(t) for t in time_s])
    flight = FlightGrid("made", time_s, {"rate_cmd_b": command})
    # The command is joined here, not held: `delayed` takes it for half a step later.
    rate = loop.loop_rates(fast, flight, {"lag": lag_s, "late": lag_s - 0.5 * STEP_S, **COUPLED})
    # The plain linear loop is 0.085 rad/s off.
    assert np.abs(rate - exact)[200:].max() < 0.02


def test_moving_air_turns_by_its_torque_over_the_gain():
    """A constant `J a` turns by a / K once the loop is at rest; at 2 m/s along y and -3 along x."""
    time_s, still = STEP_S * np.arange(400), np.zeros((400, 3))
    # The body is turned by 90 degrees: its x axis is the world's y.
    rot_w = np.tile([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], (400, 1, 1))
    vel_w = np.where(np.arange(400)[:, None] < 100, 0.0, [-2.0, -3.0, 0.0])
    bare = FlightGrid("made", time_s, {"rate_cmd_b": still})
    flight = bare._replace(signals={"rate_cmd_b": still, "vel_w": vel_w, "rot_w": rot_w})
    assert [one.name for one in loop.loop_unknowns(PLAIN, [flight])][-2:] == ["air_x", "air_y"]
    numbers = {"lag": 0.03, "late": 0.03, **COUPLED, "air_x": 0.5, "air_y": 0.4}
    rate = loop.loop_rates(PLAIN, flight, numbers)
    gain = PLAIN.controller.rate_gain
    np.testing.assert_allclose(rate[-1], [0.5 * 2.0 / gain[0], 0.4 * 3.0 / gain[1], 0.0], rtol=1e-3)
    assert "air_x" not in [one.name for one in loop.loop_unknowns(PLAIN, [flight, bare])]
