"""A diagnosis in words: the answer, its size on these flights, and what to do next."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from tracks.common.grid import Cell, Grid

VERDICTS = {
    "no_gap": "Simulation and flights agree within the measurement noise.",
    "named": "This explains the gap between simulation and flights.",
    "partly": "This explains a part of the gap between simulation and flights.",
    "unknown": "Simulation and flights differ, and no effect of the catalogue explains it.",
}
CHANGES = {
    "no_gap": "Nothing that the flights agree on has changed since the reference flights.",
    "named": "This explains what has changed since the reference flights.",
    "partly": "This explains a part of what has changed since the reference flights.",
    "unknown": "Something has changed since the reference flights, and no effect of the catalogue "
    "explains it.",
}
USE = "Use the corrected vehicle: give vehicle.toml to suite eval, train and loop (--vehicle)."
CHECK = "Run suite check on these logs: a wrong unit, sign, order or clock resembles physics."


def answer(found: Mapping[str, Any]) -> str:
    """Return what is wrong with the vehicle file, by how much, and what it explains.

    Args:
        found: what diagnosis.json holds.
    """
    words = [_named(effect) for effect in found["effects"]]
    words.append((CHANGES if found["reference"] else VERDICTS)[found["verdict"]])
    if found["verdict"] == "no_gap" and found["negligible"]:
        names = ", ".join(entry["name"] for entry in found["negligible"])
        words.append(f"Significant but too small to matter: {names}.")
    return " ".join(words)


def _named(effect: Mapping[str, Any]) -> str:
    names = " or ".join([effect["name"], *effect["alternatives"]])
    about = EFFECTS[effect["name"]].summary if effect["name"] in EFFECTS else "An effect"
    values = []
    for one in components(effect):
        if one.found:
            label, _, unit = one.label.partition(" [")
            unit = unit.rstrip("]")
            values.append(f"{label} {one.value:.3g} {'' if unit == '1' else unit}".rstrip())
    words = f"{about} ({names}){': ' if values else ''}{', '.join(values)}."
    size = effect.get("size")
    if size is None:
        return words
    parts = [f"{size['force']:.2g} m/s²", f"{size['torque']:.2g} rad/s²"]
    if size["drift"] is not None:
        parts.append(f"{size['drift']:.2g} m after one second")
    return f"{words} On these flights it causes {', '.join(parts[:-1])} and {parts[-1]} (RMS)."


def next_steps(found: Mapping[str, Any]) -> list[str]:
    """Return what to do after a verdict, most useful first.

    Args:
        found: what diagnosis.json holds.
    """
    return list(_STEPS[found["verdict"]](found))


def _no_gap(found: Mapping[str, Any]) -> Iterator[str]:
    yield "Use the vehicle file as it is."
    if found.get("not_examined"):
        yield f"These logs do not show: {', '.join(found['not_examined'])}. Log that as well."
    yield "If your task is faster than these flights, fly faster or turn harder, and repeat this."


def _separate(found: Mapping[str, Any]) -> Iterator[str]:
    for effect in found["effects"]:
        if effect["alternatives"]:
            names = ", ".join([effect["name"], *effect["alternatives"]])
            start = f"{effect['name']} from "
            flights = [line for line in found["separate_with"] if line.startswith(start)]
            yield (
                f"These flights do not separate {names}. Decide by what is known of the vehicle, "
                f"or fly what separates {'; '.join(flights)}. suite diagnose --plan writes such "
                "flights."
            )


def _explained(found: Mapping[str, Any]) -> Iterator[str]:
    yield USE
    yield from _separate(found)
    yield "Or remove the cause on the vehicle, fly again and repeat this: expect no_gap."


def _partly(found: Mapping[str, Any]) -> Iterator[str]:
    yield f"{USE} Its values are approximate; on held-out flights it is closer than the given file."
    yield from _separate(found)
    yield CHECK
    yield from _unexplained(found)


def _unknown(found: Mapping[str, Any]) -> Iterator[str]:
    yield CHECK
    if found.get("identified"):
        yield "suite identify wrote this vehicle file: repeat it if the vehicle has changed since."
    else:
        yield "Run suite identify if the numbers of the vehicle file were never estimated."
    yield from _unexplained(found)
    yield "Otherwise add an effect to the catalogue, or fit a correction with suite delta."


def _unexplained(found: Mapping[str, Any]) -> Iterator[str]:
    if found["unexplained"]["where"]:
        yield (
            "Search for the cause of what is unexplained; the report's section Remaining error "
            "shows on what it depends."
        )
    swing = found["unexplained"].get("swing")
    if swing:
        yield (
            "If the vehicle carries a load on a line, weigh it and write mass and length = "
            f"{swing['length_m']:.2g} into [effects.slung_load] of the vehicle file."
        )


_STEPS = {"no_gap": _no_gap, "named": _explained, "partly": _partly, "unknown": _unknown}


UNSEEN = "not identifiable"
"""Shown in place of a value that no flight identifies."""


class Component(NamedTuple):
    """One number of a named effect, for people."""

    label: str
    """Parameter, axis and unit."""
    value: float | None
    ci95: tuple[float, float] | None
    neutral: float | None
    """The value with which nothing acts, where it is the same for every vehicle."""

    @property
    def found(self) -> bool:
        """Whether there is a value that is not the neutral one, as far as its interval shows."""
        if self.value is None or self.ci95 is None or self.neutral is None:
            return self.value is not None
        return not self.ci95[0] <= self.neutral <= self.ci95[1]

    def shown(self) -> tuple[str, str]:
        """Return the value and its interval, in as many digits as the interval supports."""
        if self.value is None:
            return UNSEEN, ""
        if self.ci95 is None:
            return f"{self.value:.4g}", ""
        numbers = (self.value, *self.ci95)
        value, low, high = (in_digits(number, numbers) for number in numbers)
        if not self.found:
            value = f"not different from {self.neutral:g}"
        return value, f"{low} to {high}"


def in_digits(number: float, interval: Sequence[float]) -> str:
    """Return `number` with two significant digits of half the width of (value, low, high)."""
    half, size = 0.5 * (interval[2] - interval[1]), max(abs(n) for n in interval)
    if half <= 0.0 or not np.isfinite(half):
        return f"{number:.4g}"
    last = int(np.floor(np.log10(half) + 1e-6)) - 1
    if size < 1e-3 or last > 0:
        return f"{number:.{max(int(np.floor(np.log10(size))) - last, 0)}e}" if size else "0"
    return f"{number:.{-last}f}"


def components(effect: Mapping[str, Any]) -> Iterator[Component]:
    """Yield every number of a named `effect`, an entry of diagnosis.json."""
    known = EFFECTS[effect["name"]].parameters if effect["name"] in EFFECTS else ()
    neutrals = {p.name: p.neutral for p in known if not callable(p.neutral)}
    one_at_a_time = {p.name for p in known if p.one_at_a_time}
    for name, entry in effect["parameters"].items():
        value, span, unit = entry["value"], entry["ci95"], entry["unit"]
        neutral = neutrals.get(name)
        if name == "index" and one_at_a_time:
            # Each of several motors has a line of its own with its number.
            if not isinstance(value, list):
                sure = span is None or span[0] == span[1]
                yield Component(name, *_one(value, None if sure else span), None)
            continue
        if not isinstance(value, list):
            yield Component(f"{name} [{unit}]", *_one(value, span), neutral)
            continue
        which = effect["parameters"].get("index", {}).get("value")
        axes = "xyz" if len(value) <= 3 else range(1, len(value) + 1)
        if name in one_at_a_time and isinstance(which, list):
            axes = which
        for k, one in enumerate(value):
            between = span[k] if span else None
            yield Component(f"{name} {axes[k]} [{unit}]", *_one(one, between), neutral)


def _one(
    value: float | None, span: Sequence[float] | None
) -> tuple[float | None, tuple[float, float] | None]:
    return value, None if span is None else (float(span[0]), float(span[1]))


def cells(*texts: str) -> list[Cell]:
    """Return a row of cells without a tone."""
    return [Cell(text) for text in texts]


def grid(title: str, headers: Sequence[str], rows: Iterable[Sequence[str]], note: str = "") -> Grid:
    """Return a table of plain texts."""
    return Grid(title, headers, [cells(*row) for row in rows], note=note)


def short_name(name: str) -> str:
    """Return a log's name without its folders."""
    return name.replace("\\", "/").rsplit("/", 1)[-1]
