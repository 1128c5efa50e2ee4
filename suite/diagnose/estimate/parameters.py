"""The parameters of all effects as one vector, and the candidates that a diagnosis may name.

A number is one scalar of the vector, such as the x component of a drag coefficient. A candidate is
an effect of the catalogue, or a part of one, that may explain how flights differ from the model.
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
"""Separator between the names of effects that are one hypothesis."""
ParameterLayout = tuple[tuple[str, str, int | None], ...]
"""Effect, parameter and component of each number."""


@dataclass(frozen=True)
class FittedNumber:
    """One number of the vector."""

    effect: str
    parameter: str
    component: int | None
    """Place in the parameter, if that is a vector; None for a scalar."""
    low: float
    """Lower bound of the fit, in the parameter's unit."""
    high: float
    """Upper bound of the fit."""
    start: float
    """The vehicle file's value."""
    step: float
    """Usual magnitude, which scales the equations."""


@dataclass(frozen=True)
class Candidate:
    """Numbers that are fitted together, to explain how flights differ from the model."""

    name: str
    """Name of the effect; for several effects as one hypothesis, their names joined. An effect of
    single components (such as one motor) has one candidate for each, of the same name."""
    indices: tuple[int, ...]
    """Places of its numbers in the vector."""
    label: str
    """For people: the name, and the component (from 1) where there is one candidate for each."""
    parts: tuple[Candidate, ...] = ()
    """Its effects as candidates, where several are one hypothesis (a composite)."""

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of its effects."""
        return effects_in(self.name)

    @property
    def singles(self) -> tuple[Candidate, ...]:
        """One candidate for each of its effects."""
        return self.parts or (self,)


@dataclass(frozen=True)
class ParameterSpace:
    """The vector of all numbers that can be fitted on a vehicle."""

    entries: tuple[FittedNumber, ...]
    base: Mapping[str, Any]
    """The vehicle file's values of every effect."""

    def array(self, field: str) -> np.ndarray:
        """Return `field` of all entries, (P,)."""
        return np.array([getattr(entry, field) for entry in self.entries])

    def effects(self, theta: Array) -> dict[str, Any]:
        """Return the values of every effect for `theta` (P,), numpy or JAX."""
        return effects_at(self.layout, self.base, theta)

    @property
    def layout(self) -> ParameterLayout:
        """Meaning of each number of the vector; the same for every vehicle."""
        return tuple((e.effect, e.parameter, e.component) for e in self.entries)


def effects_at(layout: ParameterLayout, base: Mapping[str, Any], theta: Array) -> dict[str, Any]:
    """Return the effects `base` with the values of `theta` (P,), numpy or JAX (also traced)."""
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
    """Refuse a vehicle with an effect that has a state of its own, as a swinging load.

    No log holds that state, so no stretch of a flight can be simulated.

    Raises:
        ValueError: for such an effect, with what to do.
    """
    for name in vehicle.effects:
        if EFFECTS[name].start is not None:
            raise ValueError(
                f"{vehicle.name}: effects.{name} has a motion of its own, and no log holds it at "
                "the start of a stretch; remove it from the vehicle file here, put it back to fly"
            )


def make_space(vehicle: Vehicle) -> ParameterSpace:
    """Return the vector of `vehicle`, without random effects and what is not identifiable.

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
    """Return `vehicle` with the effects `names` replaced by their values in `theta` (P,).

    `further` holds values of other effects by name.
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
    """Return the candidates that can be identified from the signals of the logs.

    Args:
        space: of the vehicle.
        voltage: whether the logs have a battery voltage.
        has: which other signals they have that effects need: `acc_b`, an accelerometer; `command`,
            commands as the model's input.
    """
    chosen = []
    for name, effect in EFFECTS.items():
        fitted = {parameter.name: parameter for parameter in effect.identifiable(voltage)}
        indices = tuple(
            i for i, e in enumerate(space.entries) if e.effect == name and e.parameter in fitted
        )
        if not indices or not set(effect.needs) <= set(has):
            continue
        if any(parameter.one_at_a_time for parameter in fitted.values()):
            chosen += [Candidate(name, (i,), f"{name} {k + 1}") for k, i in enumerate(indices)]
        else:
            chosen.append(Candidate(name, indices, name))
    return chosen


def effects_in(name: str) -> tuple[str, ...]:
    """Return the effects of a candidate's `name`: several where they are one hypothesis."""
    return tuple(name.split(JOIN))


def indices_of(chosen: Sequence[Candidate]) -> list[int]:
    """Return the places of all numbers of the `chosen` candidates, sorted, each once."""
    return sorted({i for candidate in chosen for i in candidate.indices})


def implausible(
    space: ParameterSpace,
    theta: np.ndarray,
    candidate: Candidate,
    limits: Thresholds = THRESHOLDS,
) -> list[str]:
    """Return the implausible numbers of `candidate` at `theta` (P,), in words.

    A number is implausible beyond three times the upper usual magnitude in the catalogue.
    """
    words = []
    for index in candidate.indices:
        entry = space.entries[index]
        parameter = _parameter(entry)
        size = abs(theta[index] - (0.0 if parameter.whole else _neutral(entry)))
        if size > limits.implausible_times * parameter.typical[1]:
            place = "" if entry.component is None else f" {entry.component + 1}"
            words.append(
                f"{entry.effect} {entry.parameter}{place} = {theta[index]:.3g} {parameter.unit}"
            )
    return words


def at_bound(space: ParameterSpace, theta: np.ndarray, candidate: Candidate) -> bool:
    """Return whether a number of `candidate` is at a physical bound at `theta` (P,).

    A bound without any effect is allowed: a drag of the vehicle file may turn out to be zero.
    """
    for index in candidate.indices:
        entry, value = space.entries[index], theta[index]
        tolerance = 1e-6 * (entry.high - entry.low)
        allowed = (entry.start, _neutral(entry))
        if value <= entry.low + tolerance and entry.low not in allowed:
            return True
        if value >= entry.high - tolerance and entry.high not in allowed:
            return True
    return False


def usual_first(
    space: ParameterSpace, theta: np.ndarray, candidate: Candidate
) -> tuple[bool, int, int]:
    """Return the sort key of candidates that fit equally well, each at its own fit `theta` (P,).

    Plausible ones come first, then single effects, then the order of the catalogue.
    """
    effects = candidate.effects
    far = bool(implausible(space, theta, candidate))
    return far, len(effects), min(list(EFFECTS).index(name) for name in effects)


def _parameter(entry: FittedNumber) -> Parameter:
    return next(p for p in EFFECTS[entry.effect].parameters if p.name == entry.parameter)


def _neutral(entry: FittedNumber) -> float:
    """Return the value without any effect; the file's value where that depends on the vehicle."""
    neutral = _parameter(entry).neutral
    return entry.start if callable(neutral) else float(neutral)
