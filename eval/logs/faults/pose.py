"""Checks of attitude and position: order, direction, frames, signs and the unit of length.

A *reading* is one way to interpret the columns; the *given* reading is that of the log. Its
*misfit* is the relative violation of two conditions; 0 is a perfect fit, 1 and more is none. First,
acceleration minus gravity is thrust, so it points along body z and upwards, except for drag.
Second, the attitude rotates at the gyro's rates, in any axes and unit of the gyro.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from eval.effects.interface import GRAVITY
from eval.importers.frames import rates_between, rotate
from eval.logs.faults.finding import Finding, unseen
from eval.logs.faults.reading import ANGLES, ORDERS, axes_matrix, option, read_as
from eval.logs.faults.relation import Match, match, rms, rms_of_squares, smooth
from eval.logs.velocity import velocity_from_position

Rows = Mapping[str, np.ndarray]
"""Name of a signal -> samples (T, C), and `time` -> (T,); NaN where unknown."""
WIDTH_S, SPAN_S = 0.2, 0.06
"""Averaging time of all signals; time over which the attitude is differenced [s]."""
POINTS = 400
"""The rows are thinned to about this number to compare readings."""
CALM_RATE, CALM_ACC = 0.15, 0.5
"""Smallest usable body rates [rad/s] and accelerations [m/s^2], root mean square."""
GOOD, BAD, TIMES_BETTER = 0.45, 0.6, 2.0
"""A reading is good below the first misfit and bad above the second. The evidence is overwhelming
where a good reading's misfit is lower by the third factor."""
RIGHT = 0.25
"""Misfit of the given reading below which no other reading is tried."""
EACH = 0.06
"""Penalty on the misfit for each step of a reading, so that the simplest good one is chosen."""
FAST = 4.0
"""Accelerations that exceed this multiple of the median by 1 m/s^2 are outliers."""
DRAG, BIAS = 1.2, 1.0
"""Largest drag [1/s] and constant side force [m/s^2] that are removed from a measured force."""
# Steps of a reading of the attitude (see `reading`), "" for none: direction, frames.
_SENSES = ("", "inverse")
_FRAMES = ("", "ned", "frd", "ned+frd")
SHOWN = (
    *("attitude", "attitude_sign", "quaternion_order", "quaternion_direction", "world_frame"),
    *("body_frame", "position_axes", "position_unit"),
)
"""Faults that need an attitude to be identifiable."""
SWAPS = ("y,x,z", "z,y,x", "x,z,y", "y,z,x", "z,x,y")
"""Other orders of a position's columns; tried only with an attitude that is right as given."""
POSITIONS = (
    *("", "x,-y,-z", "y,x,-z", "-x,y,z", "x,-y,z", "x,y,-z", "-y,x,z", "y,-x,z", "-x,-y,z"),
    *SWAPS,
)
"""Readings of a position: "" for the given one, or a step for `axes_matrix`."""
LENGTHS = {1.0: "m", 0.01: "cm", 0.001: "mm", 100.0: "m, read as cm", 1000.0: "m, read as mm"}
"""Possible units of a position [m], in words; those above 1 only where nothing else is wrong."""


class Reading(NamedTuple):
    """One way to interpret the attitude and the position."""

    quat: str
    """Steps of `reading.read_as` for the attitude, "" for unchanged."""
    pos: str
    """Axes of the position, such as `x,-y,-z`, "" for unchanged."""
    length: float
    """Unit of the position [m]."""
    steps: int
    """Number of changes from the given reading."""
    misfit: float
    """Misfit of force and body rates together (root mean square of both)."""
    force: float | None
    """Misfit of the force; None where the log has no position."""
    turns: float | None
    """Misfit of the body rates; None where the log has no gyro."""
    gyro: Match | None
    """Relation of the gyro to the body rates from the attitude."""


class PoseFits(NamedTuple):
    """Result of the comparison of all readings of a pose."""

    given: Reading
    """The reading of the log."""
    best: Reading
    """The reading with the least misfit, with a penalty for each change."""
    second: float
    """Misfit of the second best reading, with a penalty for changes that the best does not need."""
    rivals: tuple[Reading, ...]
    """Alternatives: readings other than the given and the best that fit about as well."""
    level: float
    """Horizontal acceleration or tilt times gravity, root mean square [m/s^2]."""
    rate: float
    """Body rates of the gyro, root mean square, in the gyro's unit."""


def fit_pose_readings(rows: Rows) -> PoseFits | None:
    """Return the misfits of all readings; None where the rows have no attitude."""
    if "quat" not in rows:
        return None
    time_s, quat = rows["time"], _unit(rows["quat"])
    every = max(1, len(time_s) // POINTS)
    turned: dict[str, np.ndarray] = {}
    seen_as: dict[tuple[str, bool], Match] = {}
    gyro = smooth(time_s, rows["rate"], WIDTH_S)[::every] if "rate" in rows else None
    path = path_of(time_s, rows["pos"], every) if "pos" in rows else None
    rate = 0.0 if gyro is None else rms(gyro)
    found, level = [], 0.0
    for steps in _attitudes():
        positions = [pos for pos in POSITIONS if not steps or pos not in SWAPS]
        lengths = [length for length in LENGTHS if not steps or length <= 1.0]
        base = "+".join(step for step in steps.split("+") if step not in ("ned", "frd"))
        frames = {"ned", "frd"} & set(steps.split("+"))
        read, frd = read_as("quat", quat, steps) if steps else quat, "frd" in frames
        if gyro is not None and base not in turned:  # frames change no size of a rotation
            turned[base] = smooth(time_s, turns_of(time_s, read), WIDTH_S)[::every]
        if gyro is not None and (base, frd) not in seen_as:
            seen_as[base, frd] = match(
                turned[base] * [1.0, -1.0, -1.0] if frd else turned[base], gyro
            )
        seen = seen_as.get((base, frd))
        turns = None if seen is None else seen.misfit(seen.alike)
        forces: dict[tuple[str, float], tuple[float, float]] = {}
        if path is not None:
            forces = _force_misfits(axes_of(time_s, read, every), path, positions, lengths)
        # A wrong frame is one mistake, of the attitude alone or of attitude and gyro.
        count = sum(step not in ("", "ned", "frd") for step in steps.split("+")) + bool(frames)
        axes = "x,y,z" if seen is None else seen.axes
        taken = count + (axes != "x,y,z" and not ("frd" in frames and axes == "x,-y,-z"))
        for pos, length in product(positions, lengths) if path is not None else [("", 1.0)]:
            if length > 1.0 and pos:
                continue
            force, size = forces.get((pos, length), (None, 0.0))
            # The whole log is north-east-down: one mistake.
            whole = frames == {"ned", "frd"} and pos == "x,-y,-z"
            changes = taken + (pos != "") + (length != 1.0) - whole
            parts = [part for part in (force, turns) if part is not None]
            misfit = float(np.sqrt(np.mean(np.square(parts)))) if parts else 0.0
            one = Reading(steps, pos, length, changes, misfit, force, turns, seen)
            if not found:
                level, is_turned = size, seen is not None and seen.is_turned
                if force is not None and misfit < RIGHT and not is_turned:  # no other need be tried
                    return PoseFits(one, one, np.inf, (), level, rate)
            found.append(one)
    best = min(found, key=lambda one: one.misfit + EACH * one.steps)
    others = [one for one in found if one is not best and one.steps <= best.steps + 1]
    second = min((o.misfit + EACH * (o.steps - best.steps) for o in others), default=np.inf)
    alike = (one for one in others if one.misfit < best.misfit + 0.5 * EACH)
    rivals = tuple(one for one in alike if one is not found[0])
    return PoseFits(found[0], best, second, rivals, level, rate)


def check_pose(rows: Rows) -> list[Finding]:
    """Return the findings on attitude and position."""
    fits = fit_pose_readings(rows)
    if fits is None:
        return unseen("attitude", "the log has no attitude", *SHOWN) if "pos" in rows else []
    given, best = fits.given, fits.best
    figures = _figures(given)
    if not figures:
        return []
    calm = fits.level < CALM_ACC and (given.force is None or given.force < BAD)
    if calm and (given.turns is None or fits.rate < CALM_RATE):
        text = (
            f"accelerations of {fits.level:.2g} m/s^2 and turns of {fits.rate:.2g} rad/s are "
            "too small to check it by"
        )
        return unseen("attitude", text, *SHOWN)
    if not (best.quat or best.pos or best.length != 1.0):
        if given.misfit < BAD or (given.gyro is not None and given.gyro.is_turned):
            noisy = max(given.misfit, given.turns or 0.0) > GOOD
            found = Finding("note" if noisy else "ok", "attitude", figures)
            return [found, *_same_fit([r for r in fits.rivals if r.quat in ANGLES])]
        text = f"{figures}: no other order, direction, sign or frame of it fits"
        sure = 0.9 if given.misfit > 1.0 else 0.6
        return [Finding("doubt", "attitude", text, "attitude", given.misfit, sure, "see --pose")]
    better = given.misfit / max(best.misfit, 1e-3)
    clear = fits.second - best.misfit
    sure = best.misfit < GOOD and better > TIMES_BETTER and clear > 0.5 * EACH
    text = f"{figures}; {_figures(best)} if {_words(best)}"
    if given.misfit < BAD and not sure:
        return [Finding("ok", "attitude", figures)]
    confidence = 0.99 if sure and clear > 2.0 * EACH else 0.95 if better > TIMES_BETTER else 0.7
    status, changes = "corrected" if sure else "doubt", list(_changes(best))
    found = [
        Finding(status, signal, text, fault, None, confidence,
                option(*(r for r in readings if r[0] in rows)))
        for fault, signal, readings in changes
    ]  # fmt: skip
    more = _same_fit([one for one in fits.rivals if one.steps <= best.steps])
    return found + [one for one in more if one.fault not in {fault for fault, *_ in changes}]


def _same_fit(rivals: Sequence[Reading]) -> list[Finding]:
    """Return "not identifiable" findings for the faults of readings that fit as well."""
    words = {fault: _words(one) for one in rivals for fault, *_ in _changes(one)}
    text = "it fits as well if {}"
    return [one for fault, w in words.items() for one in unseen("attitude", text.format(w), fault)]


def _changes(best: Reading) -> Iterator[tuple[str, str, list[tuple[str, str]]]]:
    """Yield (fault, subject, readings that correct it) for each change of a reading."""
    if best.quat:
        steps, fault = set(best.quat.split("+")), "attitude_sign"
        if {"ned", "frd"} & steps:
            fault = "body_frame" if "ned" not in steps else "world_frame"
        fault = "quaternion_direction" if "inverse" in steps else fault
        fault = "quaternion_order" if steps & set(ORDERS) else fault
        yield fault, "attitude", [(name, best.quat) for name in ("quat", "cmd_quat")]
    axes = [best.pos] if best.pos else []
    if best.length != 1.0:
        yield "position_unit", "position", [("pos", "+".join([*axes, f"{best.length:g}"]))]
    elif best.pos:
        fault = "world_frame" if best.pos in ("x,-y,-z", "y,x,-z") else "position_axes"
        yield fault, "position", [("pos", best.pos)]


def _words(best: Reading) -> str:
    """Return the changes of a reading in words."""
    words = {
        "xyzw": "the quaternion is xyzw",
        "wxyz": "the quaternion is wxyz",
        "ned-xyzw": "the file's quaternion is xyzw",
        "ned-wxyz": "the file's quaternion is wxyz",
        "inverse": "it maps world to body",
        "ned": "its world points down",
        "frd": "its body is forward-right-down",
        "-roll": "roll has the other sign",
        "-pitch": "pitch has the other sign",
        "-yaw": "yaw has the other sign",
    }
    parts = [words[step] for step in best.quat.split("+") if step]
    parts += [f"the position's axes are {best.pos}"] if best.pos else []
    parts += [f"it is in {LENGTHS[best.length]}"] if best.length != 1.0 else []
    return " and ".join(parts)


def _figures(one: Reading) -> str:
    """Return the misfits of a reading in words."""
    parts = []
    if one.force is not None:
        parts.append(f"the force off body z is {100 * one.force:.0f} % of the acceleration")
    if one.turns is not None:
        parts.append(f"its turns are off the gyro's by {100 * one.turns:.0f} %")
    return ", ".join(parts)


def _attitudes() -> Iterator[str]:
    """Yield all readings of the attitude, the given one ("") first."""
    for base in ("+".join(s for s in (o, i) if s) for o in ("", *ORDERS) for i in _SENSES):
        for frames in _FRAMES:
            yield "+".join(s for s in (base, frames) if s)
    yield from ANGLES


def _unit(quat: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(quat, axis=1, keepdims=True)
    return np.where(norm > 0.0, quat / np.where(norm > 0.0, norm, 1.0), np.nan)


def turns_of(time_s: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Return the body rates (T, 3) from the attitude, over `SPAN_S` around each row [rad/s]."""
    count = max(1, round(0.5 * SPAN_S / float(np.median(np.diff(time_s)))))
    rates = np.full((len(time_s), 3), np.nan)
    if len(time_s) > 2 * count:
        span_s, turns = rates_between(time_s, quat, 2 * count)
        no_row_missing = span_s < 1.5 * (2 * count) * float(np.median(np.diff(time_s)))
        rates[count:-count] = np.where(no_row_missing[:, None], turns, np.nan)
    return rates


def axes_of(time_s: np.ndarray, quat: np.ndarray, every: int = 1) -> np.ndarray:
    """Return the averaged body axes in the world (N, 3, 3); `[:, :, k]` is body axis k."""
    columns = [rotate(quat, np.eye(3)[k]) for k in range(3)]
    flat = smooth(time_s, np.concatenate(columns, axis=1), WIDTH_S)[::every]
    return np.moveaxis(flat.reshape(-1, 3, 3), 1, 2)


def path_of(time_s: np.ndarray, pos: np.ndarray, every: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Return the averaged velocity and acceleration (N, 3) of a position, at every n-th row."""
    vel = velocity_from_position(time_s, pos)
    acc = velocity_from_position(time_s, vel)
    return smooth(time_s, vel, WIDTH_S)[::every], smooth(time_s, acc, WIDTH_S)[::every]


def is_usual(acc_size: np.ndarray) -> np.ndarray:
    """Return which sizes (N,) of accelerations [m/s^2] are no outliers."""
    return np.asarray(acc_size <= FAST * np.median(acc_size) + 1.0)


def without_drag(force: np.ndarray, vel: np.ndarray) -> np.ndarray:
    """Return measured forces (..., N) without the drag and the constant that fit them best.

    Each is along one axis, as the velocity `vel` (..., N). Both are at most `DRAG` and `BIAS`.
    """
    change = vel - vel.mean(axis=-1, keepdims=True)
    slope = (change * force).sum(-1) / np.maximum((change**2).sum(-1), 1e-9)
    force = force - np.clip(slope, -DRAG, 0.0)[..., None] * vel
    return force - np.clip(force.mean(axis=-1, keepdims=True), -BIAS, BIAS)


def _force_misfits(
    axes: np.ndarray,
    path: tuple[np.ndarray, np.ndarray],
    positions: Sequence[str],
    lengths: Sequence[float],
) -> dict[tuple[str, float], tuple[float, float]]:
    """Return the misfit of the force and its level for each reading (step, unit) of a position.

    There is none where path and attitude are known together in too few rows. The misfit is the
    share of the force that is not along body z, without drag. The level is what it is relative to:
    the larger of horizontal acceleration and tilt times gravity [m/s^2]. `axes` (N, 3, 3) are body
    axes in the world, `path` velocity and acceleration (N, 3) in the given reading.
    """
    good = np.isfinite(axes).all(axis=(1, 2)) & np.isfinite(path[1]).all(axis=1)
    if good.sum() < 20:
        return {}
    changes = np.stack([axes_matrix(pos or "x,y,z") for pos in positions])
    acc_size, found = np.linalg.norm(path[1][good], axis=1), {}
    for length in lengths:
        usual = is_usual(length * acc_size)
        body = np.moveaxis(axes[good][usual], 0, -1)  # (3, 3, N), rows are contiguous
        vel, acc = (length * np.ascontiguousarray(x[good][usual].T) for x in path)
        # Of each reading: (components, readings, N).
        force, vel_b = _in_body(changes, body, acc), _in_body(changes, body[:, :2], vel)
        force = force + GRAVITY * body[2][:, None]
        side = without_drag(force[:2], vel_b)
        wrong = (side**2).sum(axis=0) + np.minimum(force[2], 0.0) ** 2  # thrust only pushes
        tilt = GRAVITY * body[:2, 2]
        leaning = (tilt - tilt.mean(axis=-1, keepdims=True)) ** 2
        level = rms_of_squares(((changes[:, :2] @ acc) ** 2).sum(axis=1))
        level = np.maximum(level, rms_of_squares(leaning.sum(axis=0)))
        # A velocity may be unknown where the acceleration is not; the misfit is then 0.
        misfit = np.nan_to_num(rms_of_squares(wrong)) / np.maximum(level, CALM_ACC)
        pairs = zip(misfit.tolist(), level.tolist(), strict=True)
        found |= {(pos, length): pair for pos, pair in zip(positions, pairs, strict=True)}
    return found


def _in_body(changes: np.ndarray, body: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return vectors (3, N) after each change (C, 3, 3) along body axes (3, K, N): (K, C, N)."""
    products = (body[:, None] * value[None, :, None]).transpose(2, 0, 1, 3)
    return changes.reshape(len(changes), 9) @ products.reshape(body.shape[1], 9, -1)
