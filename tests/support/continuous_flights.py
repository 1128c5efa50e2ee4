"""Flights in continuous time: the equations of a quadrotor, integrated finely and independently.

No code of the model is used: Runge-Kutta of order 4 at a fixed fine step between the events of one
flight (a row's stamp, an update of the rate loop, a delayed command), in scalar loops. So the
diagnosis is tested against the equations and not against its own code.
"""

from types import SimpleNamespace

import numpy as np

from eval.logs.flight_log import FlightLog
from tests.support.diagnosis_flights import NOISE, curve, on_curves, track
from tracks.geometry.rotation import rot_to_quat

GRAVITY_W = np.array([0.0, 0.0, -9.81])


def skew(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


class Truth:
    """A vehicle's equations, with a lag, a linear drag and a late command."""

    def __init__(self, vehicle, lag_s=0.0, drag=(0.0, 0.0, 0.0)):
        rotors = vehicle.rotors
        self.mass, self.inertia = vehicle.mass, np.array(vehicle.inertia)
        self.gain, self.lag_s, self.drag = (
            np.array(vehicle.controller.rate_gain),
            lag_s,
            np.array(drag),
        )
        self.k_t, self.k_q = rotors.thrust_coefficient, rotors.torque_coefficient
        self.arm, self.spin = np.array(rotors.position), np.array(rotors.spin, float)
        ratio = self.k_q / self.k_t
        self.mixer = np.stack([np.ones(4), self.arm[:, 1], -self.arm[:, 0], -self.spin * ratio])
        self.most = self.k_t * rotors.speed_max**2

    def commanded(self, command, rate_b):
        """Return the rotor speeds that the loop commands; gentle commands saturate nothing."""
        torque = self.inertia * (self.gain * (command[1:] - rate_b))
        torque += np.cross(rate_b, self.inertia * rate_b)
        thrust = np.linalg.solve(self.mixer, [self.mass * command[0], *torque])
        assert (thrust > 0.0).all() and (thrust < self.most).all(), "this flight saturates"
        return np.sqrt(thrust / self.k_t)

    def force_b(self, state, speed):
        push = np.array([0.0, 0.0, (self.k_t * speed**2).sum()])
        return push - self.mass * self.drag * (state.rot.T @ state.vel)

    def slope(self, state, commanded):
        speed = commanded if self.lag_s == 0.0 else state.speed
        thrust = self.k_t * speed**2
        torque = [
            self.arm[:, 1] @ thrust,
            -self.arm[:, 0] @ thrust,
            -(self.spin * self.k_q) @ speed**2,
        ]
        force_b = self.force_b(state, speed)
        turn = np.array(torque) - np.cross(state.rate, self.inertia * state.rate)
        return SimpleNamespace(
            pos=state.vel,
            vel=state.rot @ force_b / self.mass + GRAVITY_W,
            rot=state.rot @ skew(state.rate),
            rate=turn / self.inertia,
            speed=np.zeros(4) if self.lag_s == 0.0 else (commanded - state.speed) / self.lag_s,
        )

    def rk4(self, state, commanded, h):
        def moved(slope, by):
            return SimpleNamespace(
                **{k: v + by * getattr(slope, k) for k, v in vars(state).items()}
            )

        one = self.slope(state, commanded)
        two = self.slope(moved(one, h / 2), commanded)
        three = self.slope(moved(two, h / 2), commanded)
        four = self.slope(moved(three, h), commanded)
        mean = {
            k: (getattr(one, k) + 2 * getattr(two, k) + 2 * getattr(three, k) + getattr(four, k))
            / 6
            for k in vars(state)
        }
        new = moved(SimpleNamespace(**mean), h)
        if self.lag_s == 0.0:
            new.speed = commanded
        return new


def row_times(rng, rate_hz, duration_s, jitter=0.0):
    """Return stamps whose spacing is off by up to `jitter` of a row to either side."""
    count = int(duration_s * rate_hz)
    return (np.arange(count) + rng.uniform(-0.5, 0.5, count) * jitter) / rate_hz


def fly_finely(
    vehicle, seed, duration_s=4.0, rate_hz=100.0, jitter=0.3, speed=3.0, noise=0.0,
    lag_s=0.0, delay_s=0.0, drag=(0.0, 0.0, 0.0), finest_s=5e-4,
):  # fmt: skip
    """Return the log of a flight whose rate loop starts its period anew at every row."""
    rng = np.random.default_rng(seed)
    truth, path = Truth(vehicle, lag_s, drag), curve(rng, speed)
    stamps = row_times(rng, rate_hz, duration_s, jitter)
    period = 1.0 / vehicle.controller.frequency
    pos, vel, _ = on_curves(*path, stamps[0])
    hover = truth.commanded(np.array([9.81, 0, 0, 0]), np.zeros(3))
    state = SimpleNamespace(pos=pos, vel=vel, rot=np.eye(3), rate=np.zeros(3), speed=hover)
    given, commanded, rows = [(-1.0, np.array([9.81, 0.0, 0.0, 0.0]))], hover, []
    for k, now in enumerate(stamps):
        acc = truth.force_b(state, state.speed) / truth.mass
        motion = SimpleNamespace(pos_w=state.pos, vel_w=state.vel, rot_w=state.rot)
        order = track(on_curves(*path, now), 0.4, motion)
        command = np.array([float(order.thrust), *order.rate_b])
        rows.append((state.pos, state.rot, state.vel, state.rate, acc, command))
        given.append((now, command))
        if k + 1 == len(stamps):
            break
        until = stamps[k + 1]
        looks = np.arange(now, until - 1e-9, period)
        late = [t + delay_s for t, _ in given[-80:] if now < t + delay_s < until]
        events = np.unique(np.concatenate([looks, late, [until]]))
        seen = state.rate
        for begin, end in zip(events[:-1], events[1:], strict=True):
            if np.abs(looks - begin).min() < 1e-12:
                seen = state.rate
            acts = next(c for t, c in reversed(given) if t + delay_s <= begin + 1e-12)
            commanded = truth.commanded(acts, seen)
            parts = max(int(np.ceil((end - begin) / finest_s)), 1)
            for _ in range(parts):
                state = truth.rk4(state, commanded, (end - begin) / parts)
    pos, rot, vel, rate, acc, command = (np.array(field) for field in zip(*rows, strict=True))
    blur = {name: noise * size * rng.standard_normal(pos.shape) for name, size in NOISE.items()}
    u, _, vt = np.linalg.svd(rot @ (np.eye(3) + np.array([skew(a) for a in blur["att"]])))
    return FlightLog(
        name=f"finely {seed}",
        time_s=stamps - stamps[0],
        pos_w=pos + blur["pos"],
        quat_wxyz=rot_to_quat(u @ vt),
        vel_w=vel + blur["vel"],
        rate_b=rate + blur["rate"],
        thrust_cmd=command[:, 0],
        rate_cmd_b=command[:, 1:],
        acc_b=acc + blur["acc"],
    )
