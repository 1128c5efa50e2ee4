"""Flight logs broken in the ways that real ones are."""

from dataclasses import replace

import numpy as np

FIELDS = ("pos_w", "quat_wxyz", "vel_w", "rate_b", "thrust_cmd", "rate_cmd_b", "rotor_speed")


def rows(log, chosen):
    """Return `log` with the rows at `chosen` (indices or bool) only."""
    arrays = {name: getattr(log, name) for name in (*FIELDS, "time_s", "acc_b", "voltage")}
    return replace(log, **{k: None if v is None else v[chosen] for k, v in arrays.items()})


def dropped(log, rng):
    """A third of the rows are lost."""
    return rows(log, np.sort(rng.permutation(len(log.time_s))[: 2 * len(log.time_s) // 3]))


def holed(log, rng):
    """Stretches without a pose, a rate or a command."""
    changed = {}
    for name in FIELDS:
        values = getattr(log, name)
        if values is None:
            continue
        values = values.copy()
        for first in rng.integers(0, len(values), 3):
            values[first : first + int(rng.integers(1, 60))] = np.nan
        changed[name] = values
    return replace(log, **changed)


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
    count = len(log.time_s)
    return replace(
        log,
        pos_w=np.tile([0.0, 0.0, 1.0], (count, 1)),
        quat_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        vel_w=np.zeros((count, 3)),
        rate_b=np.zeros((count, 3)),
        thrust_cmd=None if log.thrust_cmd is None else np.full(count, 9.81),
        rate_cmd_b=None if log.rate_cmd_b is None else np.zeros((count, 3)),
    )


def grounded(log, rng):
    """The vehicle stands on the ground with its rotors off."""
    quiet = still(log, rng)
    count = len(log.time_s)
    return replace(
        quiet,
        pos_w=np.tile([0.0, 0.0, 0.02], (count, 1)) + 1e-3 * rng.standard_normal((count, 3)),
        thrust_cmd=None if log.thrust_cmd is None else np.zeros(count),
        rotor_speed=None if log.rotor_speed is None else np.zeros((count, 4)),
    )


def silent(log, rng):
    """All commands are zero while it flies."""
    return replace(
        log,
        thrust_cmd=None if log.thrust_cmd is None else 0.0 * log.thrust_cmd,
        rate_cmd_b=None if log.rate_cmd_b is None else 0.0 * log.rate_cmd_b,
    )


def wild(log, rng):
    """Commands, rates and poses of a broken sensor."""
    return replace(
        log,
        pos_w=log.pos_w + 1e4 * rng.standard_normal(log.pos_w.shape),
        rate_b=100.0 * rng.standard_normal(log.rate_b.shape),
        thrust_cmd=None if log.thrust_cmd is None else 1e6 * np.abs(log.thrust_cmd),
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
