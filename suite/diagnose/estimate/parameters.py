"""The fitted parameters of all effects as one vector, and the candidates that may explain a gap.

A number is one scalar of the vector, as the x component of a drag coefficient. A candidate is an
effect, or a part of one, that a diagnosis may name.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import Parameter, bound_value
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.geometry.scene import Array

JOIN = " + "
"""Between the names of effects that are one hypothesis."""
ParameterLayout = tuple[tuple[str, str, int | None], ...]
"""Effect, parameter and component of each number."""


@dataclass(frozen=True)
class FittedNumber:
    """One number of the vector."""

    effect: str
    parameter: str
    component: int | None
    """Which of a vector, or None for a plain number."""
    low: float
    """Bounds of the fit, in the parameter's unit."""
    high: float
    start: float
    """As the vehicle file has it."""
    step: float
    """Usual magnitude, to scale equations."""


@dataclass(frozen=True)
class Candidate:
    """A way to explain a gap: numbers that are fitted together."""

    name: str
    """Of the effect; one whose components come one at a time comes once each. Of several effects
    that are one hypothesis, their names joined."""
    indices: tuple[int, ...]
    """Places in the vector."""
    label: str
    """For people: the name, and the component (from 1) where it comes once each."""
    parts: tuple[Candidate, ...] = ()
    """Where several effects are one hypothesis: each of them."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects."""
        return effects_in(self.name)

    @property
    def singles(self) -> tuple[Candidate, ...]:
        """Each of its effects as a candidate of its own."""
        return self.parts or (self,)


@dataclass(frozen=True)
class ParameterSpace:
    """The vector of all numbers that can be fitted on a vehicle."""

    entries: tuple[FittedNumber, ...]
    base: Mapping[str, Any]
    """Values of every effect, as the vehicle file has them."""

    def array(self, field: str) -> np.ndarray:
        """Return `field` of all entries, (P,)."""
        return np.array([getattr(entry, field) for entry in self.entries])

    def effects(self, theta: Array) -> dict[str, Any]:
        """Return the values of every effect for `theta` (P,), numpy or JAX."""
        return effects_at(self.layout, self.base, theta)

    @property
    def layout(self) -> ParameterLayout:
        """Which number of the vector is what; the same for every vehicle."""
        return tuple((e.effect, e.parameter, e.component) for e in self.entries)


def effects_at(layout: ParameterLayout, base: Mapping[str, Any], theta: Array) -> dict[str, Any]:
    """Return `base` with the numbers `theta` (P,) in their places; all may be traced."""
    xp = theta.__array_namespace__()
    values = {name: value._asdict() for name, value in base.items()}
    place = {entry: i for i, entry in enumerate(layout)}
    for (name, parameter, component), i in place.items():
        if component is None:
            values[name][parameter] = theta[i]
        elif component == 0:
            old = xp.asarray(getattr(base[name], parameter))
            parts = [
                theta[place[name, parameter, k]] if (name, parameter, k) in place else old[k]
                for k in range(old.shape[0])
            ]
            values[name][parameter] = xp.stack(parts)
    return {name: type(base[name])(**fields) for name, fields in values.items()}


def refuse_own_motion(vehicle: Vehicle) -> None:
    """Refuse a vehicle that no stretch of a flight can begin with.

    Raises:
        ValueError: for an effect with a motion of its own, and what to do about it.
    """
    for name in vehicle.effects:
        if EFFECTS[name].start is not None:
            raise ValueError(
                f"{vehicle.name}: effects.{name} has a motion of its own, and no log holds it at "
                "the start of a stretch; remove it from the vehicle file here, put it back to fly"
            )


def make_space(vehicle: Vehicle) -> ParameterSpace:
    """Return the vector of `vehicle`: all but what acts by chance or is not identifiable.

    Raises:
        ValueError: for a vehicle whose file has an effect with a motion of its own.
    """
    refuse_own_motion(vehicle)
    base, entries = all_values(vehicle), []
    for name, effect in EFFECTS.items():
        if not effect.by_state:
            continue
        for parameter in effect.parameters:
            if not parameter.fitted:
                continue
            now = np.atleast_1d(np.asarray(getattr(base[name], parameter.name), dtype=float))
            for k in range(max(parameter.size, 1)):
                if k in parameter.unseen:
                    continue
                entries.append(
                    FittedNumber(
                        effect=name,
                        parameter=parameter.name,
                        component=k if parameter.size else None,
                        low=bound_value(parameter.low, vehicle),
                        high=bound_value(parameter.high, vehicle),
                        start=float(now[k]),
                        step=parameter.typical[1],
                    )
                )
    return ParameterSpace(tuple(entries), base)


def with_fitted(
    vehicle: Vehicle,
    space: ParameterSpace,
    theta: np.ndarray,
    names: Collection[str],
    further: Mapping[str, Any] | None = None,
) -> Vehicle:
    """Return `vehicle` with the effects `names` at `theta` (P,) in place of what it has of them.

    `further` are values of other effects by name.
    """
    fitted, effects = space.effects(theta), dict(vehicle.effects)
    for name in set(names):
        values = (np.asarray(value, dtype=float) for value in fitted[name])
        effects[name] = type(fitted[name])(
            *(tuple(v.tolist()) if v.ndim else float(v) for v in values)
        )
    effects |= further or {}
    ordered = {name: effects[name] for name in EFFECTS if name in effects}
    return replace(vehicle, effects=MappingProxyType(ordered))


def candidates(space: ParameterSpace, voltage: bool, has: Collection[str]) -> list[Candidate]:
    """Return what may be named on logs with or without a voltage.

    Args:
        space: of the vehicle.
        voltage: the logs have one.
        has: what else they have of what effects need (`acc_b`; `command` where commands drive).
    """
    found = []
    for name, effect in EFFECTS.items():
        fitted = {parameter.name: parameter for parameter in effect.identifiable(voltage)}
        at_ = [i for i, e in enumerate(space.entries) if e.effect == name and e.parameter in fitted]
        if not at_ or not set(effect.needs) <= set(has):
            continue
        if any(parameter.one_at_a_time for parameter in fitted.values()):
            found += [Candidate(name, (i,), f"{name} {k + 1}") for k, i in enumerate(at_)]
        else:
            found.append(Candidate(name, tuple(at_), name))
    return found


def effects_in(name: str) -> tuple[str, ...]:
    """Return the effects of a candidate's `name`: several where they are one hypothesis."""
    return tuple(name.split(JOIN))


def indices_of(chosen: Sequence[Candidate]) -> list[int]:
    """Return the places of all numbers of `chosen`, in order and once each."""
    return sorted({i for candidate in chosen for i in candidate.indices})


def implausible(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    limits: Thresholds = THRESHOLDS,
) -> list[str]:
    """Return the numbers of `candidate` that are beyond their usual size at `theta` (P,), in words.

    Usual is what the catalogue has as the upper usual magnitude; beyond three times that a number
    is implausible.
    """
    words = []
    for index in candidate.indices:
        entry = space.entries[index]
        parameter = _parameter(entry)
        away = abs(theta[index] - (0.0 if parameter.whole else _neutral(entry)))
        if away > limits.implausible_times * parameter.typical[1]:
            place = "" if entry.component is None else f" {entry.component + 1}"
            words.append(
                f"{entry.effect} {entry.parameter}{place} = {theta[index]:.3g} {parameter.unit}"
            )
    return words


def at_bound(space: ParameterSpace, theta: np.ndarray, candidate: Candidate) -> bool:
    """Return whether a number of `candidate` has run to an end of what is physical.

    An end at which nothing acts is none: a drag that the vehicle file has may turn out not to be.
    """
    for index in candidate.indices:
        entry, value = space.entries[index], theta[index]
        close = 1e-6 * (entry.high - entry.low)
        sound = (entry.start, _neutral(entry))
        if value <= entry.low + close and entry.low not in sound:
            return True
        if value >= entry.high - close and entry.high not in sound:
            return True
    return False


def usual_first(
    space: ParameterSpace, theta: np.ndarray, candidate: Candidate
) -> tuple[bool, int, int]:
    """Return by what those of equal fit are ordered: what is plausible comes first.

    Then one effect comes before several, and then as the catalogue has them; `theta` (P,) is with
    this candidate.
    """
    effects = candidate.effects
    far = bool(implausible(space, theta, candidate))
    return far, len(effects), min(list(EFFECTS).index(name) for name in effects)


def _parameter(entry: FittedNumber) -> Parameter:
    return next(p for p in EFFECTS[entry.effect].parameters if p.name == entry.parameter)


def _neutral(entry: FittedNumber) -> float:
    """Return the value with which nothing acts; the file's where it depends on the vehicle."""
    neutral = _parameter(entry).neutral
    return entry.start if callable(neutral) else float(neutral)
