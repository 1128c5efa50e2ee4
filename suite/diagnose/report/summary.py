"""Writes a diagnosis in words: the answer, its size on these flights, and what to do next.

All functions take the content of diagnosis.json, so that the console and the report use the same
words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from eval.effects import EFFECTS
from suite.diagnose.sources.source import FAR
from suite.diagnose.sources.stretches import LACKING
from suite.diagnose.verdict.gap import EffectSize
from tracks.common.figures import rounded, with_unit

VERDICTS = {
    "no_gap": "Simulation and flights agree within the measurement noise.",
    "named": "This explains the gap between simulation and flights.",
    "partly": "This explains a part of the gap between simulation and flights.",
    "unknown": "Simulation and flights differ, and no effect of the catalogue explains it.",
}
"""A sentence for each verdict."""
CHANGES = {
    "no_gap": "Nothing that the flights agree on has changed since the reference flights.",
    "named": "This explains what has changed since the reference flights.",
    "partly": "This explains a part of what has changed since the reference flights.",
    "unknown": "Something has changed since the reference flights, and no effect of the catalogue "
    "explains it.",
}
"""A sentence for each verdict, if a change since reference flights was searched for."""
ONLY_VIEWS = "The forces and torques that were compared agree within the measurement noise."
"""The sentence for `no_gap` if rollouts could not be used."""
STAYS_FAR = "But simulated flights of 1 s stay far from the measured ones."
"""A further sentence if rollouts could not be used, for `no_gap` and `named`."""
ONLY_ROTORS = "This explains how measured and commanded rotor speeds differ."
"""The sentence if only a rotor lag was named: force and torque, whose gap it is, do not show it."""
ONLY_OFFSET = "This explains a constant offset of the flights."
"""The sentence if the named effects lower the flights' offsets, which are no part of the gap."""
NEGLIGIBLE = {
    False: "Significant but too small to matter",
    True: "Perhaps only an error of the model, or cancelled by another effect",
}
"""Reason why an effect was left out, by whether its own size is relevant."""
USE = (
    "Use the corrected vehicle: give the new vehicle.toml, in --out, to suite eval, train and loop "
    "(--vehicle)."
)
USE_FOR_LOGS = (
    "Give the new vehicle.toml, in --out, to suite diagnose (--vehicle) with logs that have this "
    "error: it allows for it. The vehicle is right as far as these flights show."
)
HEADINGS = {
    False: {False: "Wrong or missing in the vehicle file:", True: "Wrong in the logs:"},
    True: {False: "Changed in the vehicle:", True: "Changed in the logs:"},
}
"""Headings of named effects, by whether a change was searched for, and whether of the log."""
UNTESTED = "Whether the file itself is right was not tested: for that, leave out --reference."
CHECK = (
    "Verify the signals: a log's errors resemble physics. Read the notes of suite check: a small "
    "error of a scale or a filter is a note, and stops no diagnosis."
)
LEAST_SHOWN = 0.001
"""A smaller gap is printed as "less than" this value, in the unit of the gap."""


def headline(result: Mapping[str, Any]) -> str:
    """Return the answer of a diagnosis.json: effects, sizes, verdict, gap, and what remains."""
    words, gap = [answer(result)], result["gap"]
    # The unit of rollouts is the noise floor itself.
    floor = "" if gap["noise_floor"] == 1.0 else f" (noise floor {figure(gap['noise_floor'])})"
    before, after = f"{figure(gap['before'])} to ", f"{figure(gap['after'])} {gap['unit']}"
    if gap["after"] < gap["before"]:
        words.append(f"On held-out flights the {gap['of']} falls from {before}{after}{floor}.")
    elif not result["effects"]:
        words.append(f"On held-out flights the {gap['of']} is {after}{floor}.")
    offsets = [
        f"{figure(offset['after'])} {offset['unit']} ({view})"
        for view, offset in gap["offset"].items()
        if offset["after"] >= result["relevance"].get(view, 0.0)
    ]
    if offsets:
        words.append(
            "A constant offset of each flight remains, which does not count as a gap: "
            f"{', '.join(offsets)}."
        )
    if result["unexplained"]["where"]:
        words.append(f"Unexplained: {result['unexplained']['where']}.")
    return superscripts(" ".join(words))


def superscripts(text: str) -> str:
    """Return `text` with the powers of its units as people write them."""
    return text.replace("^2", "²")


def figure(value: float) -> str:
    """Return a gap as text; logs without noise give values such as 1e-10 and 41,400."""
    return rounded(value, 3) if value >= LEAST_SHOWN else f"less than {LEAST_SHOWN:g}"


def answer(result: Mapping[str, Any]) -> str:
    """Return the named effects, their sizes, the verdict, and the errors that it excludes."""
    verdict, is_change = result["verdict"], bool(result["reference"])
    words = list[str]()
    for in_log, heading in HEADINGS[is_change].items():
        effects = [one for one in result["effects"] if is_of_log(one) == in_log]
        words += [heading, *map(_effect_words, effects)] if effects else []
    if other := _explains_instead(result):
        words.append(other)
        verdict = {"named": "no_gap", "partly": "unknown"}[verdict]
    sentence, rest = (CHANGES if is_change else VERDICTS)[verdict], remaining_words(result)
    is_far = FAR in result.get("warnings", ())
    sentence = ONLY_VIEWS if is_far and verdict == "no_gap" else sentence
    if rest and (verdict == "named" or (verdict == "no_gap" and not is_change)):
        agreed = sentence.removesuffix(".").removesuffix(" within the measurement noise")
        sentence = f"{agreed}, except for {rest}."
    words += [sentence, *([STAYS_FAR] if is_far and verdict in ("no_gap", "named") else [])]
    for is_large, reason in NEGLIGIBLE.items() if verdict == "no_gap" else ():
        names = [one["name"] for one in result["negligible"] if one["relevant"] == is_large]
        words += [f"{reason}: {', '.join(names)}."] * bool(names)
    if verdict == "no_gap" and (hidden := _not_visible(result)):
        words.append(f"These flights would not show {' or '.join(hidden.values())}.")
    return " ".join(words)


def _not_visible(result: Mapping[str, Any]) -> dict[str, str]:
    """Return words for a relevant constant force or torque that the flights do not show, by it."""
    if not (visible := result.get("visible")):
        return {}
    units, least = {"force": "m/s^2", "torque": "rad/s^2"}, result["relevance"]
    return {
        name: f"a constant {name} below {rounded(visible[name], 2)} {unit}"
        for name, unit in units.items()
        if visible[name] > least[name] > 0.0
    }


def _explains_instead(result: Mapping[str, Any]) -> str:
    """Return what the named effects explain in place of the gap; empty if they explain the gap."""
    effects, gap = result["effects"], result["gap"]
    views = {one["view"] for one in effects}
    if views == {"commands"}:
        return ONLY_ROTORS
    # A random wind explains an error without lowering it.
    if (
        len(views) != 1
        or gap["after"] < gap["before"]
        or any(e["gap_removed"] is None for e in effects)
    ):
        return ""
    is_lower = any(offset["after"] < offset["before"] for offset in gap["offset"].values())
    return ONLY_OFFSET if is_lower else ""


def remaining_words(result: Mapping[str, Any]) -> str:
    """Return words for the errors that remain clearly above the noise floor; empty without any."""
    reasons = [entry["reason"] for entry in result["unexplained"]["above_noise"]]
    return " and ".join(f"an error {reason}" for reason in dict.fromkeys(reasons))


def is_of_log(effect: Mapping[str, Any]) -> bool:
    """Return whether a named effect is an error of the logs, not of the vehicle file."""
    return effect["name"] in EFFECTS and EFFECTS[effect["name"]].of_log


def _effect_words(effect: Mapping[str, Any]) -> str:
    """Return a sentence on a named effect, and one on its size on these flights."""
    names = " or ".join([effect["name"], *effect["alternatives"]])
    summary = EFFECTS[effect["name"]].summary if effect["name"] in EFFECTS else "An effect"
    known = [one for one in components(effect) if one.value is not None]
    # At most three significant digits, and no more than the interval supports.
    values = ", ".join(
        with_unit(f"{one.name} {min(f'{one.value:.3g}', one.texts()[0], key=len)}", one.unit)
        + (f" (vehicle file: {one.file:.3g})" if one.file else "")
        for one in known
        if one.is_significant
    ) or ", ".join(f"{one.name} {one.texts()[0]}" for one in known)
    words = f"{summary} ({names}){': ' if values else ''}{values}."
    if motors := effect["parameters"].get("index"):
        pairs = zip(np.atleast_1d(motors["value"]), motors["place"], strict=True)
        words += f" Rotor {', '.join(f'{number} is {place}' for number, place in pairs)}."
    if effect["size"] is None:
        return words
    return f"{words} On these flights it causes {EffectSize(**effect['size']).words()} (RMS)."


def next_steps(result: Mapping[str, Any]) -> list[str]:
    """Return advice on what to do after the verdict of a diagnosis.json, most useful first."""
    verdict, is_change = result["verdict"], bool(result["reference"])
    search_for = _search_for(result["unexplained"])
    if verdict == "no_gap" and FAR in result.get("warnings", ()):
        return [CHECK, "Then estimate the rate loop with suite identify, and repeat this."]
    if verdict == "no_gap":
        if is_change:
            return [f"Keep the vehicle file that you use. {UNTESTED}"]
        steps = ["Use the vehicle file as it is."]
        if hidden := " or ".join(_not_visible(result)):
            lacks = LACKING in result.get("warnings", ()) or result.get("driven_by") != "commands"
            how = "log every command, and fly longer" if lacks else "fly longer"
            steps.append(f"To see a smaller {hidden}, {how}.")
        return [
            *steps,
            "If your task is faster than these flights, fly faster or turn harder, and repeat "
            "this.",
        ]
    if verdict == "unknown":
        if is_change:
            return [CHECK, "Look for what was changed on the vehicle.", *search_for]
        return [
            CHECK,
            "suite identify wrote this vehicle file: repeat it if the vehicle has changed since."
            if result.get("identified")
            else "Run suite identify if the numbers of the vehicle file were never estimated.",
            *search_for,
            "Otherwise add an effect to the catalogue, or fit a correction with suite delta.",
        ]
    use = USE_FOR_LOGS if all(map(is_of_log, result["effects"])) else USE
    steps = [f"{use} It is your file with this change. {UNTESTED}" if is_change else use]
    for effect in result["effects"]:
        if effect["alternatives"]:
            names = ", ".join([effect["name"], *effect["alternatives"]])
            start = f"{effect['name']} from "
            flights = [line for line in result["separate_with"] if line.startswith(start)]
            steps.append(
                f"These flights do not separate {names}. Decide by what is known of the vehicle, "
                f"or fly what separates {'; '.join(flights)}. suite diagnose --plan writes such "
                "flights."
            )
    if verdict == "named":
        last = "Or remove the cause, fly again and repeat this: expect no_gap."
        return [*steps, last]
    is_closer = result["gap"]["after"] < result["gap"]["before"]
    closer = "; on held-out flights it is closer than your file" if is_closer else ""
    steps[0] += f" Its values are approximate{closer}."
    return [*steps, CHECK, *search_for]


def _search_for(unexplained: Mapping[str, Any]) -> list[str]:
    """Return advice on the remaining error: what it depends on, and an oscillating force."""
    steps = []
    if unexplained["where"]:
        steps.append(
            superscripts(
                f"Search for the cause of the unexplained error: {unexplained['where']}. The "
                "report's section Remaining error has its size, and the quantities that it "
                "depends on."
            )
        )
    if swing := unexplained.get("swing"):  # an oscillating force, as of a load on a line
        steps.append(
            "If the vehicle carries a load on a line, weigh it and write mass and length = "
            f"{swing['length_m']:.2g} into [effects.slung_load] of the vehicle file."
        )
    return steps


class Component(NamedTuple):
    """One value of a named effect, for people: a parameter, or one axis of it."""

    name: str
    """Name of the parameter, with its axis or motor."""
    unit: str
    """Unit; empty for a number that counts."""
    value: float | None
    """Value, or None if it is not identifiable."""
    ci95: Sequence[float] | None
    """95 % interval."""
    file: float | None
    """Value in the vehicle file; that of no effect if the file lacks the effect."""

    @property
    def label(self) -> str:
        """Name and unit."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    @property
    def file_text(self) -> str:
        """The value in the vehicle file as text; empty if it is unknown."""
        return "" if self.file is None else f"{self.file:.4g}"

    @property
    def is_significant(self) -> bool:
        """Whether there is a value that differs significantly from that of the vehicle file."""
        if self.value is None or self.file is None:
            return self.value is not None
        low, high = self.ci95 or (self.value, self.value)
        return not low <= self.file <= high

    def texts(self) -> tuple[str, str]:
        """Return value and interval as texts, with as many digits as the interval supports."""
        if self.value is None:
            return "not identifiable", ""
        if self.ci95 is None:
            return f"{self.value:.4g}", ""
        if not self.unit:
            return f"{self.value}", f"{self.ci95[0]} to {self.ci95[1]}"
        numbers = (self.value, *self.ci95)
        value, low, high = (in_digits(number, numbers) for number in numbers)
        if not self.is_significant:
            value += f" (not different from {self.file:g})"
        return value, f"{low} to {high}"


def in_digits(number: float, interval: Sequence[float]) -> str:
    """Return `number` to the second significant digit of half the `interval` (value, low, high).

    Small numbers, and those with no digit behind the point, are written with an exponent.
    """
    half, size = 0.5 * (interval[2] - interval[1]), max(abs(n) for n in interval)
    if half <= 0.0 or not np.isfinite(half):
        return f"{number:.4g}"
    last_power = int(np.floor(np.log10(half) + 1e-6)) - 1  # power of ten of the last digit
    if size < 1e-3 or last_power > 0:
        digits = max(int(np.floor(np.log10(size))) - last_power, 0) if size else 0
        return f"{number:.{digits}e}" if size else "0"
    return f"{number:.{-last_power}f}"


def components(effect: Mapping[str, Any]) -> list[Component]:
    """Return the components of a named `effect` in diagnosis.json, significant ones first."""
    found = list[Component]()
    parameters = EFFECTS[effect["name"]].parameters if effect["name"] in EFFECTS else ()
    by_motor = {p.name for p in parameters if p.one_at_a_time}
    motors = effect["parameters"].get("index", {}).get("value")
    for name, entry in effect["parameters"].items():
        value, span, unit = entry["value"], entry["ci95"], entry["unit"]
        if name == "index" and by_motor:
            # The numbers of the motors. Those of several motors are in the labels below instead.
            if not isinstance(value, list):
                found.append(Component(name, "", value, None if span[0] == span[1] else span, None))
        elif not isinstance(value, list):
            found.append(Component(name, unit, value, span, entry.get("file")))
        else:
            axes = "xyz" if len(value) <= 3 else range(1, len(value) + 1)
            if name in by_motor and isinstance(motors, list):
                axes = motors
            spans, files = (part or [None] * len(value) for part in (span, entry.get("file")))
            for axis, *one in zip(axes, value, spans, files, strict=False):
                found.append(Component(f"{name} {axis}", unit, *one))
    return sorted(found, key=lambda component: not component.is_significant)


def short_name(name: str) -> str:
    """Return a log's name without its folders."""
    return name.replace("\\", "/").rsplit("/", 1)[-1]
