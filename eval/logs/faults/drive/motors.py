"""Checks of the motors: number, order, spin, the unit of their speeds, and their lift.

*Lift*: thrust by the rotor speeds and the vehicle file, over the force that the measured motion
needs; 1 is correct. *Mixer*: matrix from the thrusts of the motors to torques about x, y and z.
"""

from __future__ import annotations

from itertools import permutations

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import conjugate, rotate
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.pose import WIDTH_S, Rows
from eval.logs.faults.reading import option
from eval.logs.faults.relation import forward_mean, rms, shift_rows, smooth, within
from eval.logs.velocity import HALF_WINDOW_S, velocity_from_position
from eval.vehicles.vehicle import Vehicle, motor_thrust

SPAN_S = 0.08
"""Angular accelerations are differences of the body rate over this time; torques are averaged over
it [s]."""
LAGS_S = (0.0, 0.02, 0.04, 0.06)
"""Possible delays from commands to torques [s]."""
CALM_TURN = 0.3
"""Smallest usable angular acceleration, root mean square [rad/s^2]."""
RIGHT, SURELY, WRONG, CLEAR = 0.3, 0.5, -0.3, 0.4
"""Limits of the correlation of torque and angular acceleration about roll and pitch. An order of
motors is possible above the first, certain above the second and wrong below the third. The sum of
its two correlations must exceed that of the log's order by the fourth."""
AS_GIVEN = (0, 1, 2, 3)
"""The order of the motors in the log."""
TURNING = 0.05
"""A motor that never reaches this share of the fastest one counts as stopped."""
FITS = 1.35
"""A lift within this factor of 1 may be a physical effect, which a diagnosis names."""
AGILE = 3.0
"""Mean lift of a flight, in multiples of the weight, that turns may need; more is a fault."""
INERTIA = 2.5
"""Least factor of an inertia that is a fault; a diagnosis estimates smaller ones itself (effect
`inertia_scale`)."""
UNITS = {
    "rpm in place of rad/s": 60.0 / (2.0 * np.pi),
    "revolutions a second in place of rad/s": 1.0 / (2.0 * np.pi),
    "rad/s, read as rpm": 2.0 * np.pi / 60.0,
    "revolutions a second, read as rpm": 1.0 / 60.0,
    **{f"electrical, of {pairs} pole pairs": float(pairs) for pairs in (6, 7, 11, 12, 14)},
    **{
        f"electrical rpm of {pairs} pole pairs, in place of rad/s": pairs * 60.0 / (2.0 * np.pi)
        for pairs in (6, 7, 11)
    },
}
"""Wrong unit -> factor by which rotor speeds are then too large."""
NEAR, ALONE = 1.2, 1.1
"""A wrong unit is possible if its factor is within the first ratio of the measured factor. It is
certain if it is the only one within the second ratio."""
SAME = 1.07
"""A lift within this factor of 1 agrees with the vehicle file."""
MAGNETS = (12, 14, 16, 22, 24, 28)
"""Usual numbers of poles (magnets) of a motor."""
POLES = {
    f"{mine} poles were declared of {true}": true / mine
    for mine in MAGNETS
    for true in MAGNETS
    if 0.5 <= mine / true <= 2.0 and mine != true
}
"""Wrong number of poles -> factor by which speeds from electrical rpm (eRPM) are then too large."""
COEFFICIENT = (
    "or --vehicle is another vehicle's file, or its rotors.thrust_coefficient is wrong, as for rpm"
)
"""Other causes of a wrong lift, which a log alone does not exclude."""
SHIPPED_ORDER = ((1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0), (1.0, 1.0))
"""Motor positions (x forward, y left) in the order of the shipped vehicles: front right, rear
right, rear left, front left."""
X_SPIN = (1, -1, 1, -1)
"""Directions of rotation in the same order."""


def check_count(turning: int, whose: str) -> list[Finding]:
    """Return a finding where the number of turning motors is not four.

    `whose` completes the sentence "N motors ... turn", such as the name of the log's source.
    """
    if turning == 4 or turning == 0:
        return []
    text = f"{turning} motors {whose} turn; four are read, and the models here have four"
    fix = "none: only quadrotors can be diagnosed"
    return [Finding("doubt", "motors", text, "motor_count", float(turning), 0.97, fix)]


def check_motors(rows: Rows, vehicle: Vehicle | None) -> list[Finding]:
    """Return stopped motors, and whether order and spin agree with the angular accelerations."""
    name = _drive(rows)
    if name is None:
        return []
    speed = rows[name]
    fastest = np.nanmax(np.abs(speed), axis=0) if np.isfinite(speed).any() else np.zeros(4)
    stopped = [str(k + 1) for k in range(4) if not fastest[k] > TURNING * np.max(fastest)]
    if stopped:
        text = f"motors {', '.join(stopped)} of 4 never turn: a dead motor, or a wrong column"
        return [Finding("doubt", "motors", text, "motor_dead", float(len(stopped)), 0.97,
                        "the columns of the motors in --map")]  # fmt: skip
    if "rate" not in rows:
        return unseen("motors", "the log has no gyro", "motor_order", "motor_spin")
    return _order(rows, name, vehicle)


def torque_correlations(rows: Rows, vehicle: Vehicle | None) -> np.ndarray | None:
    """Return the correlations (3,) of torque and angular acceleration for the log's motor order.

    The result is None where the log lacks a signal or the vehicle hardly turns.
    """
    name = _drive(rows)
    torques = "" if name is None or "rate" not in rows else _delayed_torques(rows, name, vehicle)
    return None if isinstance(torques, str) else scores_of(*torques)[AS_GIVEN]


def check_inertia(rows: Rows, vehicle: Vehicle | None) -> list[Finding]:
    """Return the finding on an inertia that is far from what the turns need, [] for none.

    The attitude must confirm the gyro, and the motors lift the weight by the file: otherwise these
    may be the cause, and other checks name them.
    """
    range_ = turn_scale(rows, vehicle) if "quat" in rows else None
    if vehicle is None or range_ is None or 1.0 / INERTIA < range_[1] and range_[0] < INERTIA:
        return []
    if "motor" in rows and not 1.0 / FITS < _lift(rows, vehicle) < FITS:
        return []
    ratio = float(np.sqrt(range_[0] * range_[1]))
    text = (
        f"by {vehicle.name!r} the body needs {ratio:.3g} times the torques that the motors give: "
        "its inertia over its arms is wrong by this factor"
    )
    fix = "inertia in kg m^2 and rotors.position in m of this vehicle, or suite identify"
    return [Finding("doubt", "motors", text, "vehicle_inertia", ratio, 0.93, fix)]


def turn_scale(rows: Rows, vehicle: Vehicle | None) -> tuple[float, float] | None:
    """Return the torques by the gyro over those of the motors, by the vehicle file.

    The result is the least and the largest ratio: noise of the motors lowers the first, and noise
    of the gyro raises the second. It is 1 for a correct gyro and vehicle file. It is None where the
    log or the file lacks a value, or the torques hardly explain the turns.
    """
    name = _drive(rows)
    if vehicle is None or name is None or "rate" not in rows:
        return None
    torques = _delayed_torques(rows, name, vehicle)
    if isinstance(torques, str) or (name == "pwm" and vehicle.motors is None):
        return None
    mean, turning, mixer = torques
    newtons = 1.0 if name == "pwm" else vehicle.rotors.thrust_coefficient
    torque = newtons * mean @ mixer[:2].T  # the mixer's third row has no unit
    good = np.isfinite(torque).all(axis=1) & np.isfinite(turning).all(axis=1)
    a, b = (v[good] - v[good].mean(axis=0) for v in (torque, turning[:, :2]))
    slope = np.sum(a * b, axis=0) / np.maximum(np.sum(a * a, axis=0), 1e-18)
    correlations = _correlations(mean @ mixer[:2].T, turning[:, :2]).diagonal()
    if not (slope > 0.0).all() or correlations.min() < SURELY:
        return None
    least = float(np.sqrt(slope.prod()))
    return least, least / float(correlations.prod())


def _drive(rows: Rows) -> str | None:
    """Return the name of the best signal of the motors in the log: speeds before commands."""
    return next((n for n in ("motor", "pwm", "motor_cmd") if n in rows), None)


def torques_of(
    rows: Rows, name: str, vehicle: Vehicle | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
    """Return the motors' mean thrusts (N, 4), the torques by the gyro (N, 3) and the mixer (3, 4).

    Each is that of the time `SPAN_S` from a row on. The torque by the gyro is the change of the
    angular momentum. Without a vehicle file the inertia is set to 1. If the flight is too short or
    too calm, the result is the reason in words.
    """
    hubs = np.array(SHIPPED_ORDER if vehicle is None else [h[:2] for h in vehicle.rotors.position])
    spin = np.array(X_SPIN if vehicle is None else vehicle.rotors.spin, dtype=float)
    mixer = np.stack([hubs[:, 1], -hubs[:, 0], -spin * np.abs(hubs).max()], axis=0)
    time_s, rate = rows["time"], rows["rate"]
    # The square of speed or command stands for the thrust where no map is known.
    motors = vehicle.motors if vehicle is not None and name == "pwm" else None
    thrust = rows[name] ** 2 if motors is None else np.asarray(motor_thrust(motors, rows[name]))
    count = max(1, round(SPAN_S / float(np.median(np.diff(time_s)))))
    if len(time_s) < 20 * count:
        return "the flight is too short"
    inertia = np.array([1.0, 1.0, 1.0] if vehicle is None else vehicle.inertia)
    momentum = rate * inertia
    change = (momentum[count:] - momentum[:-count]) / (time_s[count:] - time_s[:-count])[:, None]
    gyroscopic = np.cross(rate, momentum)[: len(change)] if vehicle is not None else 0.0
    turning = change + gyroscopic
    size = rms(turning / inertia)
    if size < CALM_TURN:
        return f"turns change by {size:.2g} rad/s^2 only, too little to check their order by"
    return forward_mean(thrust, count)[:-1], turning, mixer


def _delayed_torques(
    rows: Rows, name: str, vehicle: Vehicle | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
    """Return `torques_of`, with the delay of the thrusts that correlates best."""
    torques = torques_of(rows, name, vehicle)
    if isinstance(torques, str):
        return torques
    mean, turning, mixer = torques
    step = float(np.median(np.diff(rows["time"])))
    delayed_means = [shift_rows(mean, round(lag / step)) for lag in LAGS_S]
    mean = max(delayed_means, key=lambda one: float(np.sum(_correlations(one, turning) ** 2)))
    return mean, turning, mixer


def _order(rows: Rows, name: str, vehicle: Vehicle | None) -> list[Finding]:
    """Return the findings on the order and spin of the motors.

    The torques in every order of the four motors are compared with the angular accelerations.
    """
    torques = _delayed_torques(rows, name, vehicle)
    if isinstance(torques, str):
        return unseen("motors", torques, "motor_order", "motor_spin")
    mean, turning, mixer = torques
    scores = scores_of(mean, turning, mixer)
    half = len(mean) // 2
    halves = [
        scores_of(mean[part], turning[part], mixer) for part in (slice(half), slice(half, None))
    ]
    as_given, best = scores[AS_GIVEN], _best(scores)
    values = ", ".join(
        f"{axis} {value:+.2f}"
        for axis, value in zip(("roll", "pitch", "yaw"), as_given, strict=True)
    )
    figures = f"correlations of their torques with how the body turns are {values}"
    gain = float(scores[best][:2].sum() - as_given[:2].sum())
    if gain > CLEAR and scores[best][:2].min() > RIGHT and all(best == _best(h) for h in halves):
        order = ",".join(str(k + 1) for k in best)
        text = f"{figures}; {scores[best][0]:+.2f}, {scores[best][1]:+.2f} in the order {order}"
        if vehicle is not None:
            text += "; or rotors.position of the vehicle file has another order or sign"
        names = [n for n in ("motor", "motor_cmd", "pwm") if n in rows]
        clear = scores[best][:2].min() > SURELY and gain > 2.0 * CLEAR
        status, sure = ("corrected", 0.99) if clear else ("doubt", 0.92)
        fix = option(*((n, order) for n in names))
        return [Finding(status, "motors", text, "motor_order", None, sure, fix)]
    if as_given[:2].min() < WRONG:
        sure, fix = (0.9, "the motors' columns") if as_given[:2].max() < RIGHT else (0.6, "")
        text = f"{figures}: no order of them fits"
        return [Finding("doubt", "motors", text, "motor_order", None, sure, fix)]
    if as_given[:2].min() < RIGHT:
        text = f"{figures}, too little to check their order by"
        return unseen("motors", text, "motor_order", "motor_spin")
    if as_given[2] < WRONG and all(h[AS_GIVEN][2] < WRONG for h in halves):
        text = f"{figures}: all of them turn the other way round"
        fix = "rotors.spin of the vehicle file, with the other signs"
        return [Finding("doubt", "motors", text, "motor_spin", -1.0, 0.95, fix)]
    text = f"{figures}: yaw shows too little of their spin"
    weak = [] if as_given[2] > RIGHT else unseen("motors", text, "motor_spin")
    return [Finding("ok", "motors", figures), *weak]


Scores = dict[tuple[int, ...], np.ndarray]
"""Order of the motors -> correlation of torque and angular acceleration about x, y and z."""


def scores_of(mean: np.ndarray, turning: np.ndarray, mixer: np.ndarray) -> Scores:
    """Return the correlations of every order of the motors."""
    mean, turning = _centred(mean, turning)
    products, moments, size = mean.T @ turning, mean.T @ mean, np.linalg.norm(turning, axis=0)
    scores = {}
    for order in permutations(range(4)):
        mix = mixer[:, np.argsort(order)]  # of the columns as given
        squares = np.maximum(np.sum((mix @ moments) * mix, axis=1), 0.0)
        sizes = np.maximum(np.sqrt(squares) * size, 1e-12)
        scores[order] = np.sum(mix * products.T, axis=1) / sizes
    return scores


def _best(scores: Scores) -> tuple[int, ...]:
    """Return the order with the largest sum of the correlations about roll and pitch."""
    return max(scores, key=lambda order: float(scores[order][:2].sum()))


def _correlations(mean: np.ndarray, turning: np.ndarray) -> np.ndarray:
    """Return the correlation of each column of `mean` with each of `turning`."""
    a, b = _centred(mean, turning)
    size = np.outer(np.linalg.norm(a, axis=0), np.linalg.norm(b, axis=0))
    return (a.T @ b) / np.maximum(size, 1e-12)


def _centred(mean: np.ndarray, turning: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows where both are known, less their means."""
    good = np.isfinite(mean).all(axis=1) & np.isfinite(turning).all(axis=1)
    mean, turning = mean[good], turning[good]
    return mean - mean.mean(axis=0), turning - turning.mean(axis=0)


def check_lift(rows: Rows, vehicle: Vehicle | None, doubtful: bool = False) -> list[Finding]:
    """Compare the rotors' thrust by the vehicle file with the path's acceleration.

    `doubtful`: there is a vehicle file, but it is implausible, so no check uses it.
    """
    if "motor" not in rows:
        return []
    if vehicle is None:
        why = ": the vehicle file is in doubt" if doubtful else "; --vehicle makes it possible"
        return [Finding("note", "rotor speeds", f"not checked against the weight{why}")]
    if not (lift := _lift(rows, vehicle)) > 0.0:
        return []
    figures = f"by {vehicle.name!r} they lift {lift:.3g} times the weight"
    if SAME < lift < AGILE and "acc" not in rows and not {"quat", "pos"} <= rows.keys():
        text = f"{figures}, which turns may need: no accelerometer and no pose show the force"
        return unseen("rotor speeds", text, "motor_poles")
    if 1.0 / FITS < lift < FITS:
        if abs(np.log(lift)) < np.log(SAME):
            return [Finding("ok", "rotor speeds", figures)]
        text = f"{figures}: an effect, which suite diagnose names, or a mass that is off"
        return [Finding("note", "rotor speeds", text, "thrust_scale", lift, 0.9)]
    return [_of_factor(rows, vehicle, float(np.sqrt(lift)), figures)]


def _lift(rows: Rows, vehicle: Vehicle) -> float:
    """Return the rotors' thrust by the vehicle file over the force that the path needs; 0: none."""
    thrust = vehicle.rotors.thrust_coefficient * np.sum(rows["motor"] ** 2, axis=1)
    return fit_force(rows, thrust)[1] / vehicle.mass


def _of_factor(rows: Rows, vehicle: Vehicle, factor: float, figures: str) -> Finding:
    """Return the finding for a lift of `factor`^2, as speeds `factor` times too large give.

    Causes are tried in this order: wrong unit, mass entered per link, wrong number of poles.
    """
    near = within(UNITS, NEAR, factor)
    certain = within(UNITS, ALONE, factor)
    names = [n for n in ("motor", "motor_cmd") if n in rows]
    if len(certain) == 1:
        (words,) = certain
        text = f"{figures}: they are {UNITS[words]:.3g} times the true ones ({words})"
        others = " or ".join(name for name in near if name != words)
        text += f"; if the vehicle file is far off, it may be {others}" if others else ""
        text += f"; {COEFFICIENT}"
        fix = option(*((n, f"{1.0 / UNITS[words]:.10g}") for n in names))
        about = ("motor_unit", UNITS[words], 0.97, fix)
        return Finding("corrected", "rotor speeds", text, *about)
    if near:
        text = f"{figures}: they are {factor:.3g} times too large, which may be {' or '.join(near)}"
        text += f"; {COEFFICIENT}"
        fix = option(*((n, f"{1.0 / factor:.4g}") for n in names))
        return Finding("doubt", "rotor speeds", text, "motor_unit", factor, 0.95, fix)
    poles = sorted(within(POLES, 1.05, factor), key=lambda n: abs(np.log(factor / POLES[n])))
    links = [n for n in range(2, 9) if abs(np.log(factor**-2 / n)) < np.log(1.1)]
    if links:
        text = f"{figures}: {vehicle.mass:g} kg may be the mass of {links[0]} links, entered each"
        text += f"; {COEFFICIENT}"
        fix = f"mass = {vehicle.mass / links[0]:.3g} in the vehicle file"
        return Finding("doubt", "mass", text, "vehicle_mass", factor**-2, 0.9, fix)
    if poles:
        text = f"{figures}: if they are from eRPM, {poles[0]}; or the mass is wrong, {COEFFICIENT}"
        fix = f"the --vehicle of this log, or --motor-poles {poles[0].split(' ')[-1]} for eRPM"
        return Finding("doubt", "rotor speeds", text, "motor_poles", factor, 0.9, fix)
    text = f"{figures}: the speeds' unit or the mass is wrong, {COEFFICIENT}"
    fix = "the --vehicle of this log, or mass or rotors.thrust_coefficient of the vehicle file"
    return Finding("doubt", "rotor speeds", text, "motor_unit", factor, 0.9, fix)


def fit_force(rows: Rows, thrust: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the force per mass along body z without drag, (T,) [m/s^2], and `thrust` (T,) over it.

    A thrust in newtons gives a mass [kg], a thrust in m/s^2 a dimensionless ratio; 0 means that
    nothing could be fitted. The force comes from the path where the log has a pose, from the
    accelerometer otherwise (then without a correction for drag), and is gravity where the log has
    neither. Force and thrust are averaged over `WIDTH_S` as vectors in the same axes, since the
    body may rotate within this time. At the ends of a path its acceleration is too uncertain.
    """
    time_s = rows["time"]
    drag, thrust = np.zeros((len(time_s), 0)), thrust[:, None]
    force, inside = np.full(len(time_s), GRAVITY), np.ones(len(time_s), bool)
    if "quat" in rows and "pos" in rows:
        quat, vel = conjugate(rows["quat"]), velocity_from_position(time_s, rows["pos"])
        acc = smooth(time_s, velocity_from_position(time_s, vel), WIDTH_S)
        force = rotate(quat, acc + [0.0, 0.0, GRAVITY])[:, 2]
        up_w = rotate(rows["quat"], np.broadcast_to([0.0, 0.0, 1.0], acc.shape))
        thrust = rotate(quat, smooth(time_s, thrust * up_w, WIDTH_S))[:, 2:]
        vel_z = rotate(quat, vel)[:, 2:]
        drag = np.concatenate([vel_z, vel_z * np.linalg.norm(vel, axis=1, keepdims=True)], axis=1)
        end_s = 2.0 * max(HALF_WINDOW_S, 2.0 * float(np.median(np.diff(time_s))))
        inside = (time_s - time_s[0] >= end_s) & (time_s[-1] - time_s >= end_s)
    elif "acc" in rows:
        force = smooth(time_s, rows["acc"][:, 2:], WIDTH_S)[:, 0]
        thrust = smooth(time_s, thrust, WIDTH_S)
    columns = np.concatenate([thrust, drag], axis=1)
    good = inside & np.isfinite(force) & np.isfinite(columns).all(axis=1)
    if not good.any() or not np.any(thrust[good]):
        return force, 0.0
    coefficients = np.linalg.lstsq(columns[good], force[good], rcond=None)[0]
    share = float(coefficients[0])
    return force - drag @ coefficients[1:], 1.0 / share if share > 0.0 else 0.0
