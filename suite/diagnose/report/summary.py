"""The first screen of a report: the answer, its size on these flights, and what to do next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from eval.effects import EFFECTS
from suite.diagnose.report.parameters_json import components

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
CHECK = "Run suite check on these logs: a wrong unit, sign, order or clock looks like physics."


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
                f"These flights do not separate {names}. Decide by what you know of the vehicle, "
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
        yield f"Look for a cause of the remaining error: {found['unexplained']['where']}."


_STEPS = {"no_gap": _no_gap, "named": _explained, "partly": _partly, "unknown": _unknown}
