"""The nominal rate loop under its commands alone."""

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from suite.diagnose.identify.grid import STEP_S, FlightGrid
from suite.diagnose.identify.loop import air_torque_unknowns, coupling_unknowns, loop_rates
from tests.support.vehicles import PLAIN

COUPLED = {unknown.name: unknown.start for unknown in coupling_unknowns(PLAIN)}


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
    rate = loop_rates(flight, fast, {"lag": lag_s, "late": lag_s - 0.5 * STEP_S, **COUPLED})
    # The plain linear loop is 0.085 rad/s off.
    assert np.abs(rate - exact)[200:].max() < 0.02


def test_moving_air_turns_by_its_torque_over_the_gain():
    """A constant `J a` turns by a / K once the loop is at rest; at 2 m/s along y and -3 along x."""
    count = 400
    known = {
        "rate_cmd_b": np.zeros((count, 3)),
        "vel_w": np.zeros((count, 3)),
        "rot_w": np.tile([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], (count, 1, 1)),
    }
    # The body is turned by 90 degrees: its x axis is the world's y.
    known["vel_w"][100:] = [-2.0, -3.0, 0.0]
    flight = FlightGrid("made", STEP_S * np.arange(count), known)
    assert [one.name for one in air_torque_unknowns([flight])] == ["air_x", "air_y"]
    numbers = {"lag": 0.03, "late": 0.03, **COUPLED, "air_x": 0.5, "air_y": 0.4}
    rate = loop_rates(flight, PLAIN, numbers)
    gain = PLAIN.controller.rate_gain
    np.testing.assert_allclose(rate[-1], [0.5 * 2.0 / gain[0], 0.4 * 3.0 / gain[1], 0.0], rtol=1e-3)
    bare = FlightGrid("made", flight.time_s, {"rate_cmd_b": known["rate_cmd_b"]})
    assert air_torque_unknowns([flight, bare]) == []
