"""What an import gave, beside the flight that the file was made from; and tables to import."""

import csv

import numpy as np

from tests.support import known_flight

NAMES = {
    "pos": ["pos_x", "pos_y", "pos_z"],
    "quat": ["quat_w", "quat_x", "quat_y", "quat_z"],
    "vel": ["vel_x", "vel_y", "vel_z"],
    "rate": ["rate_x", "rate_y", "rate_z"],
    "acc": ["acc_x", "acc_y", "acc_z"],
    "cmd_thrust": ["cmd_thrust"],
    "cmd_rate": ["cmd_rate_x", "cmd_rate_y", "cmd_rate_z"],
}


def flight(hz=200.0, end=8.0, noise=0.0, seed=0):
    """The columns of a good table as arrays by signal."""
    truth = known_flight.fly(np.arange(0, end, 1 / hz))
    rng = np.random.default_rng(seed)
    same = ("time", "pos", "quat", "vel", "rate", "acc", "cmd_rate")
    parts = {name: getattr(truth, name) for name in same} | {"cmd_thrust": truth.thrust[:, None]}
    if noise:
        sizes = {"pos": 0.003, "vel": 0.05, "rate": 0.05, "acc": 0.5, "quat": 0.0015}
        for name, size in sizes.items():
            parts[name] = parts[name] + noise * size * rng.normal(size=parts[name].shape)
        parts["quat"] /= np.linalg.norm(parts["quat"], axis=1, keepdims=True)
    return parts


def write(path, parts, keep=None):
    """Write `parts` as CSV; cells that `keep` (signal -> mask of rows) leaves out stay empty."""
    columns = {"time": [repr(float(t)) for t in parts["time"]]}
    for name in [name for name in NAMES if name in parts]:
        mask = (keep or {}).get(name, np.ones(len(parts["time"]), bool))
        for column, values in zip(NAMES[name], parts[name].T, strict=True):
            rows = zip(values, mask, strict=True)
            columns[column] = [repr(float(v)) if kept else "" for v, kept in rows]
    with path.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        table.writerows(zip(*columns.values(), strict=True))
    return path


def of(findings, level):
    """The subjects of that level."""
    return {finding.signal for finding in findings if finding.status == level}


def levels(findings):
    """Level by subject."""
    return {finding.signal: finding.status for finding in findings}


def text(findings, subject):
    """All that is said of a subject."""
    return " ".join(finding.evidence for finding in findings if finding.signal == subject)


def quat_off(log, truth):
    """The largest difference of quaternions, whatever their signs."""
    sign = np.sign(np.sum(log.quat_wxyz * truth.quat, axis=1, keepdims=True))
    return np.abs(log.quat_wxyz * sign - truth.quat).max()


TRUE = {
    "pos_w": "pos", "vel_w": "vel", "rate_b": "rate", "acc_b": "acc", "rate_cmd_b": "cmd_rate",
    "thrust_cmd": "thrust", "rotor_speed": "motor", "voltage": "voltage",
}  # fmt: skip
"""What a field of a log is called in the known flight."""


def same_flight(log, truth, quat, **tolerances):
    """Check fields of `log` against the known flight, each within its tolerance."""
    assert quat_off(log, truth) < quat
    for name, tolerance in tolerances.items():
        near(getattr(log, name), getattr(truth, TRUE[name]), tolerance)


def near(value, wanted, tolerance):
    """Check what is known of `value`, which must be nearly all, against `wanted`."""
    # Signals that are slower than the rows end before them.
    value, wanted = np.asarray(value), np.asarray(wanted)
    known = np.isfinite(value)
    assert known.mean() > 0.97
    value, wanted = value[known], np.broadcast_to(wanted, known.shape)[known]
    np.testing.assert_allclose(value, wanted, rtol=0, atol=tolerance)
