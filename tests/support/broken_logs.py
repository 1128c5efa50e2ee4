"""Flight logs broken in the ways that real ones are."""

from dataclasses import replace

import numpy as np

FIELDS = ("pos_w", "quat_wxyz", "vel_w", "rate_b", "thrust_cmd", "rate_cmd_b", "rotor_speed")


def rows(log, chosen):
    """Return `log` with the rows at `chosen` (indices or bool) only."""
    names = (*FIELDS, "time_s", "acc_b", "voltage", "torque_cmd_b", "pwm", "rotor_speed_cmd")
    return changed(log, **dict.fromkeys(names, lambda values: values[chosen]))


def changed(log, **functions):
    """Return `log` with a function of the values in some fields, where it has them."""
    have = {name: getattr(log, name) for name in functions}
    return replace(log, **{k: functions[k](v) for k, v in have.items() if v is not None})


def on_the_ground(log, before_s, after_s):
    """Return a log with so much time [s] on the ground before and after, rotors at rest."""
    step = float(np.median(np.diff(log.time_s)))
    count, ends = len(log.time_s), (round(before_s / step), round(after_s / step))
    longer = rows(log, np.pad(np.arange(count), ends, mode="edge"))
    flown = np.pad(np.ones(count), ends)
    longer = replace(longer, time_s=step * np.arange(len(flown)))
    names = ("vel_w", "rotor_speed", "thrust_cmd")
    return changed(longer, **dict.fromkeys(names, lambda values: (values.T * flown).T))


def dropped(log, rng):
    """A third of the rows are lost."""
    return rows(log, np.sort(rng.permutation(len(log.time_s))[: 2 * len(log.time_s) // 3]))


def holed(log, rng):
    """Stretches without a pose, a rate or a command."""

    def with_holes(values):
        values = values.copy()
        for first in rng.integers(0, len(values), 3):
            values[first : first + int(rng.integers(1, 60))] = np.nan
        return values

    return changed(log, **dict.fromkeys(FIELDS, with_holes))


def jittered(log, rng):
    """Rows at uneven times."""
    step = np.diff(log.time_s, prepend=log.time_s[0] - 0.01)
    return replace(log, time_s=np.cumsum(step * rng.uniform(0.1, 1.9, len(step))))


def doubled(log, rng):
    """Rows a microsecond apart."""
    late = log.time_s.copy()
    late[1::7] = late[:-1:7][: len(late[1::7])] + 1e-6
    return replace(log, time_s=late)


def still(log, rng):
    """A hover without noise: nothing changes at all."""
    rest = {"pos_w": [0.0, 0.0, 1.0], "quat_wxyz": [1.0, 0.0, 0.0, 0.0], "thrust_cmd": 9.81}
    rest |= dict.fromkeys(("vel_w", "rate_b", "rate_cmd_b"), 0.0)
    return changed(log, **{k: lambda v, at=at: np.zeros(v.shape) + at for k, at in rest.items()})


def grounded(log, rng):
    """The vehicle stands on the ground with its rotors off."""
    quiet = silent(still(log, rng), rng)
    noise = 1e-3 * rng.standard_normal(log.pos_w.shape)
    return changed(quiet, pos_w=lambda v: v * [0.0, 0.0, 0.02] + noise, rotor_speed=np.zeros_like)


def silent(log, rng):
    """All commands are zero while it flies."""
    return changed(log, thrust_cmd=np.zeros_like, rate_cmd_b=np.zeros_like)


def wild(log, rng):
    """Commands, rates and poses of a broken sensor."""
    return changed(
        log,
        pos_w=lambda v: v + 1e4 * rng.standard_normal(v.shape),
        rate_b=lambda v: 100.0 * rng.standard_normal(v.shape),
        thrust_cmd=lambda v: 1e6 * np.abs(v),
    )


def sparse(log, rng):
    """Ten rows a second."""
    return rows(log, np.arange(0, len(log.time_s), 10))


def short(log, rng):
    """Little more than a second."""
    return rows(log, np.flatnonzero(log.time_s - log.time_s[0] < 1.2 + rng.random()))


def turned_over(log, rng):
    """Quaternions of the other order."""
    return replace(log, quat_wxyz=np.roll(log.quat_wxyz, 1, axis=1))


def far_away(log, rng):
    """The world's origin is elsewhere, as with GPS."""
    return replace(log, pos_w=log.pos_w + [60e3, -40e3, 300.0])


BREAKAGES = (
    dropped, holed, jittered, doubled, still, grounded, silent, wild, sparse, short, turned_over,
    far_away,
)  # fmt: skip


def with_sent_commands(log, late_s):
    """Return `log` with its commands in rows of their own, `late_s` (T,) [s] after the states."""
    twice = rows(log, np.repeat(np.arange(len(log.time_s)), 2))
    is_sent = np.arange(len(twice.time_s)) % 2 == 1

    def kept(chosen):
        return lambda values: np.where(chosen, values.T, np.nan).T

    commands = ("thrust_cmd", "rate_cmd_b")
    parts = {name: kept(is_sent if name in commands else ~is_sent) for name in FIELDS}
    extra = {name: np.repeat(values, 2) for name, values in log.extra.items()}
    time_s = twice.time_s + np.where(is_sent, np.repeat(late_s, 2), 0.0)
    return replace(changed(twice, **parts), time_s=time_s, extra=extra)
