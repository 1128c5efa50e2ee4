"""From flights and a vehicle to a diagnosis."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS
from eval.flight_log import FlightLog
from eval.vehicle import Vehicle
from suite.diagnose.evidence import Frame, State, fit
from suite.diagnose.gap import Gap, measure
from suite.diagnose.intervals import errors_of
from suite.diagnose.model import Model
from suite.diagnose.parameters import candidates, indices_of, make_space
from suite.diagnose.search import Finding, search, start_state
from suite.diagnose.windows import Windows, cut, take

STRUCTURE = 1.15
"""Slow errors above their expectation by this factor are no noise."""
STRUCTURE_BY_ROTORS = 1.3
"""The same where measured rotor speeds drive the model: their noise is known less well."""
REST = 0.1
"""A structured rest below this share of the gap is left unsaid."""
MOSTLY = 0.5
"""Where what was found explains less than this share of the gap, the gap is unknown."""
OVERLAP_S = 0.25
"""From one start to the next of the rollouts that measure the gap [s]."""
ONE_FLIGHT = 0.7
"""Share of a lone flight that is fitted; the rest is held out."""
FEW = 10
"""Signs of fewer stretches can be shuffled in too few ways for a p-value of 1 %."""
FOLLOWS = 0.5
"""Rotor speeds that the nominal rate loop predicts worse than this share of their own spread are
another controller's: they are the input then."""


@dataclass(frozen=True)
class Diagnosis:
    """What was found, before it is written down."""

    verdict: str
    finding: Finding
    vehicle: Vehicle
    """With the named effects."""
    widths: np.ndarray
    """Half-widths of the 95 % intervals, in the order of `finding.indices`."""
    before: Gap
    after: Gap
    without: dict[str, Gap]
    """By a named effect's label: the gap with all others."""
    control: tuple[str, Gap] | None
    """A wrong effect fitted in the same way, and its gap."""
    held_out: list[str]
    share_left: float
    """Structured rest over the structured gap before."""
    where: str | None
    driven_by: str
    seconds: float
    warnings: list[str]
    model: Model
    held: Windows


def diagnose(
    logs: Sequence[FlightLog],
    vehicle: Vehicle,
    drive: str = "auto",
    say: Callable[[str], None] = lambda _: None,
) -> Diagnosis:
    """Find what explains how `logs` differ from `vehicle`.

    Args:
        logs: flights; the last fifth of them, at least one, is held out (of a lone flight, the
            last 30 %).
        vehicle: the one that the simulation used.
        drive: what drives the model: "commands", "motors", or "auto".
        say: told of the search's steps.

    Raises:
        ValueError: where no flight can be used, or not in the way that was asked for.
    """
    began = time.monotonic()
    by_rotors, warnings = _choose_drive(logs, drive)
    space = make_space(vehicle)
    voltage = all(log.voltage is not None for log in logs)
    model = Model(vehicle, space, by_rotors, voltage)
    cut_, notes = cut(logs, vehicle, by_rotors)
    if cut_ is None:
        raise ValueError("no flight has a stretch of 1.3 s without holes; log more, or faster")
    if drive == "auto" and not by_rotors and _other_controller(model, cut_):
        warnings.append("the nominal rate loop does not give the measured rotor speeds; they drive")
        by_rotors = True
        model = Model(vehicle, space, by_rotors, voltage)
        cut_, notes = cut(logs, vehicle, by_rotors)
        assert cut_ is not None
    warnings += notes
    cut_, broken = _finite(model, cut_)
    if broken:
        warnings.append(f"{broken} stretches left out: the model's flight from there diverges")
    inside, names = _split(logs, cut_)
    if inside.sum() < 4:
        raise ValueError(
            f"{int(inside.sum())} stretches of 1 s to fit, at least 4 are needed: fly longer"
        )
    if inside.sum() < FEW:
        warnings.append(
            f"{int(inside.sum())} stretches of 1 s to fit: fewer than {FEW} cannot name"
        )
    windows, rest = take(cut_, inside), take(cut_, ~inside)
    among = candidates(space, voltage, any(log.acc_b is not None for log in logs))
    if by_rotors:
        among = [c for c in among if c.name not in ("motor_lag", "command_delay", "rate_gain")]
    say(f"{len(windows.flight)} stretches of 1 s to fit, {len(rest.flight)} held out")
    finding = search(model, windows, among, say)

    held = _held_out(logs, vehicle, by_rotors, rest)
    start = start_state(model, windows).theta
    before = measure(model, start, held, finding.sigma)
    after = measure(model, finding.state.theta, held, finding.sigma) if finding.named else before
    if finding.named and after.rms > before.rms:
        warnings.append("what was found on the fitted flights does not hold on held-out ones")
        finding.named.clear()
    verdict, share = _verdict(finding, STRUCTURE_BY_ROTORS if by_rotors else STRUCTURE)
    if verdict in ("no_gap", "unknown"):
        if finding.named:
            labels = ", ".join(n.candidate.label for n in finding.named)
            warnings.append(f"nearest in the catalogue, but it leaves most of the gap: {labels}")
        finding.named.clear()
        after = before
    without: dict[str, Gap] = {}
    for one in finding.named:
        others = [n.candidate for n in finding.named if n is not one]
        theta = start
        if others:
            theta = finding.state.theta.copy()
            theta[list(one.candidate.indices)] = start[list(one.candidate.indices)]
            state = State(theta, finding.state.offset)
            theta = fit(model, windows, finding.frame, state, indices_of(others))[0].theta
        without[one.candidate.label] = measure(model, theta, held, finding.sigma)
    control = _control(model, windows, finding, held) if finding.named else None
    return Diagnosis(
        verdict=verdict,
        finding=finding,
        vehicle=_with_effects(vehicle, model, finding) if finding.named else vehicle,
        widths=errors_of(finding.sums),
        before=before,
        after=after,
        without=without,
        control=control,
        held_out=names,
        share_left=share,
        where=_where(finding) if verdict in ("partly", "unknown") else None,
        driven_by="measured rotor speeds" if by_rotors else "commands",
        seconds=time.monotonic() - began,
        warnings=warnings,
        model=model,
        held=held,
    )


def _choose_drive(logs: Sequence[FlightLog], drive: str) -> tuple[bool, list[str]]:
    commands = all(log.thrust_cmd is not None for log in logs)
    motors = all(log.rotor_speed is not None for log in logs)
    if drive not in ("auto", "commands", "motors"):
        raise ValueError(f"drive = {drive!r}; allowed: auto, commands, motors")
    if not commands and not motors:
        raise ValueError("some flights have commands only and some rotor speeds only: sort them")
    if (drive == "commands" and not commands) or (drive == "motors" and not motors):
        raise ValueError(f"drive = {drive!r}, but not every flight has them")
    return drive == "motors" or not commands, []


def _other_controller(model: Model, windows: Windows) -> bool:
    seen = np.asarray(windows.seen)[..., 15:]
    if not seen.any():
        return False
    theta = model.space.array("start")
    residual = model.residual(theta, np.zeros((len(windows.flight), model.free)), windows)[..., 15:]
    early = seen & (np.asarray(windows.row_s) < 0.1)[..., None]
    error = residual[early]
    spread = np.std(np.asarray(windows.row_rotor_speed)[seen])
    good = error[np.isfinite(error)]
    return bool(len(good) and np.median(np.abs(good - np.median(good))) > FOLLOWS * spread)


def _finite(model: Model, windows: Windows) -> tuple[Windows, int]:
    theta = model.space.array("start")
    residual = model.residual(theta, np.zeros((len(windows.flight), model.free)), windows)
    good = np.isfinite(residual).all(axis=(1, 2)) & (np.abs(residual[..., :3]) < 50).all((1, 2))
    if not good.any():
        raise ValueError(
            "the model diverges on every flight: check the vehicle file and the frames"
        )
    return take(windows, good), int((~good).sum())


def _split(logs: Sequence[FlightLog], windows: Windows) -> tuple[np.ndarray, list[str]]:
    """Return which windows are fitted, and the names of what is held out."""
    flight, start = np.asarray(windows.flight), np.asarray(windows.start_s)
    there = np.unique(flight)
    if len(there) == 1:
        cut_s = ONE_FLIGHT * logs[int(there[0])].duration_s
        name = logs[int(there[0])].name
        return start + 1.0 <= cut_s, [f"{name} from {cut_s:.1f} s"]
    held = there[-max(1, round(0.2 * len(there))) :]
    return ~np.isin(flight, held), [logs[int(k)].name for k in held]


def _held_out(
    logs: Sequence[FlightLog], vehicle: Vehicle, by_rotors: bool, rest: Windows
) -> Windows:
    """Return overlapping windows over what is held out."""
    if not len(rest.flight):
        raise ValueError("nothing is left to hold out: fly longer, or log a second flight")
    many, _ = cut(logs, vehicle, by_rotors, OVERLAP_S)
    assert many is not None
    inside = np.isin(many.flight, rest.flight) & (many.start_s >= rest.start_s.min() - 1e-6)
    return take(many, inside)


def _verdict(finding: Finding, limit: float) -> tuple[str, float]:
    before, after = float(finding.slow_before.mean()), float(finding.slow_after.mean())
    share = max(after - 1.0, 0.0) / max(before - 1.0, 1e-3)
    structured = after > limit
    if not finding.named:
        return ("unknown", 1.0) if structured else ("no_gap", 0.0)
    if structured and share > MOSTLY:
        return "unknown", share
    return ("partly" if structured and share > REST else "named"), min(share, 1.0)


def _where(finding: Finding) -> str:
    groups = ("position", "attitude", "velocity", "rates")
    energy = np.maximum(finding.slow_after.mean(axis=0) - 1.0, 0.0)
    names = [f"{groups[k // 3]} {'xyz'[k % 3]}" for k in np.argsort(-energy)[:3] if energy[k] > 0]
    return ", ".join(names)


def _control(
    model: Model, windows: Windows, finding: Finding, held: Windows
) -> tuple[str, Gap] | None:
    """Return the best effect that is neither named nor a rival, fitted alone, and its gap."""
    taken = {n.candidate.name for n in finding.named}
    taken |= {rival for n in finding.named for rival in n.rivals}
    wrong = next((s.candidate for s in finding.first if s.candidate.name not in taken), None)
    if wrong is None:
        return None
    frame: Frame = finding.frame
    state = start_state(model, windows)
    theta = fit(model, windows, frame, state, list(wrong.indices))[0].theta
    return wrong.label, measure(model, theta, held, finding.sigma)


def _with_effects(vehicle: Vehicle, model: Model, finding: Finding) -> Vehicle:
    """Return `vehicle` with the named effects in place of what it has of them."""
    fitted: dict[str, Any] = model.space.effects(finding.state.theta)
    effects = dict(vehicle.effects)
    for name in {n.candidate.name for n in finding.named}:
        values = []
        for value in fitted[name]:
            plain = np.asarray(value, dtype=float)
            values.append(tuple(plain.tolist()) if plain.ndim else float(plain))
        effects[name] = type(fitted[name])(*values)
    ordered = {name: effects[name] for name in EFFECTS if name in effects}
    return replace(vehicle, effects=MappingProxyType(ordered))
