"""The parameters of all effects as one vector, and the candidates that a diagnosis may name.

A number is one scalar of the vector, such as the x component of a drag coefficient. A candidate is
an effect that may explain how flights differ from the model; or one component of an effect, such as
one motor, or several effects as one hypothesis (a composite).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eval.effects import EFFECTS, all_values
from eval.effects.interface import Parameter, bound_value
from eval.vehicles.vehicle import Vehicle
from suite.diagnose.thresholds import THRESHOLDS, Thresholds
from tracks.common.figures import with_unit
from tracks.geometry.scene import Array

JOIN = " + "
"""Separator between the names of the effects of a composite."""
ParameterLayout = tuple[tuple[str, str, int | None], ...]
"""Name of the effect, name of the parameter, and component, for each number of the vector."""


@dataclass(frozen=True)
class FittedNumber:
    """One number of the vector."""

    effect: str
    parameter: str
    component: int | None
    """Place of the number in its parameter, from 0; None if the parameter is a scalar."""
    low: float
    """Lower bound of the fit, in the parameter's unit."""
    high: float
    """Upper bound of the fit, in the parameter's unit."""
    start: float
    """Value in the vehicle file, with which a fit starts."""
    step: float
    """Usual magnitude of the number, which scales the equations of a fit."""
    tried: tuple[float, ...] = ()
    """Further values at which the model is evaluated, see `Parameter.tried`."""


@dataclass(frozen=True)
class Candidate:
    """Numbers that are fitted together, to explain how flights differ from the model."""

    name: str
    """Name of the effect; of a composite, the names of its effects joined by `JOIN`. If each
    component is a candidate of its own (such as one weak motor), all have the same name."""
    indices: tuple[int, ...]
    """Places of the candidate's numbers in the vector."""
    label: str
    """Name for people, with the component (from 1) where each component is a candidate."""
    parts: tuple[Candidate, ...] = ()
    """The effects of a composite as candidates; () for a single effect."""

    @property
    def singles(self) -> tuple[Candidate, ...]:
        """One candidate for each effect: the parts of a composite, or the candidate itself."""
        return self.parts or (self,)


@dataclass(frozen=True)
class ParameterSpace:
    """The vector of all numbers that can be fitted on a vehicle."""

    entries: tuple[FittedNumber, ...]
    base: Mapping[str, Any]
    """Values of the vehicle file's effects, and of every effect that may be named."""

    def array(self, field: str) -> np.ndarray:
        """Return the values of one `field` of all P entries, (P,)."""
        return np.array([getattr(entry, field) for entry in self.entries])

    def effects(self, theta: Array) -> dict[str, Any]:
        """Return the values of the effects in `base` for `theta` (P,), numpy or JAX."""
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
        elif component == 0:  # all components of a vector at once, when its first one comes
            base_value = xp.asarray(getattr(base[name], parameter))
            parts = [
                theta[place[name, parameter, k]] if (name, parameter, k) in place else base_value[k]
                for k in range(base_value.shape[0])
            ]
            values[name][parameter] = xp.stack(parts)
    return {name: type(base[name])(**fields) for name, fields in values.items()}


def refuse_own_motion(vehicle: Vehicle) -> None:
    """Raise a ValueError for an effect with a state of its own, such as a swinging load.

    No log holds that state, so no stretch of a flight can be simulated.
    """
    for name in vehicle.effects:
        if EFFECTS[name].start is not None:
            raise ValueError(
                f"{vehicle.name}: effects.{name} has a motion of its own, and no log holds it at "
                "the start of a stretch; remove it from the vehicle file here, put it back to fly"
            )


def make_space(vehicle: Vehicle) -> ParameterSpace:
    """Return the space of all numbers that flights of `vehicle` can identify.

    It has no random effects, effects with a state, known constants, and unseen components.

    Raises:
        ValueError: for a vehicle whose file has an effect with a motion of its own.
    """
    refuse_own_motion(vehicle)
    present = all_values(vehicle)
    base = {n: v for n, v in present.items() if n in vehicle.effects or EFFECTS[n].nameable}
    entries = list[FittedNumber]()
    for name, effect in EFFECTS.items():
        if name not in base or not effect.by_state:  # random, or with a state of its own
            continue
        for parameter in effect.parameters:
            if not parameter.fitted:
                continue
            now = np.atleast_1d(np.asarray(getattr(base[name], parameter.name), dtype=float))
            for k in range(max(parameter.size, 1)):
                if k in parameter.unseen:  # a component that is not identifiable from flights
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
                        tried=parameter.tried,
                    )
                )
    return ParameterSpace(tuple(entries), base)


def candidates(space: ParameterSpace, voltage: bool, has: Collection[str]) -> list[Candidate]:
    """Return the candidates that can be identified from the signals of the logs.

    `has` names further signals: `acc_b` (an accelerometer), `command` (commands as the input).
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
    """Return the names of the effects in a candidate's `name`; a composite has several."""
    return tuple(name.split(JOIN))


def indices_of(chosen: Sequence[Candidate]) -> list[int]:
    """Return the places of all numbers of the `chosen` candidates, sorted, without repetition."""
    return sorted({i for candidate in chosen for i in candidate.indices})


def implausible(
    space: ParameterSpace, theta: np.ndarray, candidate: Candidate, limits: Thresholds = THRESHOLDS
) -> list[str]:
    """Return a phrase for each number of `candidate` far above its usual range in `theta` (P,)."""
    phrases = []
    for index in candidate.indices:
        entry = space.entries[index]
        parameter = parameter_of(entry)
        # The usual range is one of values (`whole`), or of differences from no effect.
        size = abs(theta[index] - (0.0 if parameter.whole else _neutral(entry)))
        if size > limits.implausible_times * parameter.typical[1]:
            suffix = "" if entry.component is None else f" {entry.component + 1}"
            value = with_unit(f"{theta[index]:.3g}", parameter.unit)
            phrases.append(f"{entry.effect} {entry.parameter}{suffix} = {value}")
    return phrases


def at_bound(space: ParameterSpace, theta: np.ndarray, candidate: Candidate) -> bool:
    """Return whether a number of `candidate` in `theta` (P,) is at a physical bound.

    Bounds at which the effect is absent, or the file is, do not count: a drag may be zero.
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
    """Return the sort key of `candidate` at its fit `theta` (P,), for equally good candidates.

    Plausible ones come first, then single effects, then the order of the catalogue.
    """
    effects, far = effects_in(candidate.name), bool(implausible(space, theta, candidate))
    return far, len(effects), min(list(EFFECTS).index(name) for name in effects)


def parameter_of(entry: FittedNumber) -> Parameter:
    """Return the parameter in the catalogue to which a number belongs."""
    return next(p for p in EFFECTS[entry.effect].parameters if p.name == entry.parameter)


def _neutral(entry: FittedNumber) -> float:
    """Return the value at which the effect is absent; the file's value if the vehicle sets it."""
    neutral = parameter_of(entry).neutral
    return entry.start if callable(neutral) else float(neutral)
