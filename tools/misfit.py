"""A model that is wrong by design: is what the diagnosis names still true?

    python tools/misfit.py COUNT [SEED]

Every case hides a linear drag and a force over the place that no effect describes. The force is so
strong that a model with the right drag is off by 20 times the noise.
Prints a line a case, one process a core, then how many 95 % intervals of the drag hold the truth
and how many cases have a false name.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator, Sequence

import numpy as np

from eval.effects import EFFECTS
from eval.flights.follow import FlightFailed
from eval.flights.trajectory import ordinary_flights
from eval.judging.statistics import wilson
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion, Wrench
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.blind.cases import CONTINUOUS, Case
from suite.blind.outside import Law, Push
from suite.blind.simulators import simulator_for
from suite.common.startup import keep_compiled
from suite.diagnose.data.colour import Noise, measured_noise
from suite.diagnose.data.windows import cut
from suite.diagnose.diagnose import diagnose
from suite.diagnose.estimate.parameters import make_space
from suite.diagnose.evidence.rollouts import RolloutModel, start_estimate
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.verdict.rollout_gap import gap_of
from tracks.common.work import run_pieces, usable_cores
from tracks.common.work.threads import one_thread_a_product

OFF = 20.0
"""How far flights are off a model that has the drag, in units of noise."""
DRAG = "linear_drag"
WAVES = 3
"""Of the force along each axis of the world."""
LENGTH_M = (3.0, 10.0)
"""Shortest and longest of them [m]."""
FIRST = 0.3
"""The force's root mean square that is tried first [m/s^2]."""
TRIES = 8
"""Draws until one can be flown."""


def force_law(rng: np.random.Generator) -> Law:
    """Return a smooth force over the place with a root mean square of `strength` an axis."""
    way = rng.standard_normal((3, WAVES, 3))
    length_m = rng.uniform(*LENGTH_M, (3, WAVES, 1))
    way *= 2.0 * np.pi / length_m / np.linalg.norm(way, axis=-1, keepdims=True)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, WAVES))
    size = rng.standard_normal((3, WAVES))
    size *= np.sqrt(2.0 / (size**2).sum(axis=1, keepdims=True))

    def law(strength: float, mass: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
        along = np.einsum("akw,nw->nak", way, motion.pos_w)
        return strength * (size * np.sin(along + phase)).sum(axis=-1)

    return law


def gap_with(
    logs: Sequence[FlightLog], vehicle: Vehicle, noise: Noise | None
) -> tuple[float, Noise]:
    """Return how far `logs` are off `vehicle`, in units of `noise` or else their own; and it."""
    windows, _ = cut(logs, vehicle, rotor_input=False)
    assert windows is not None
    model = RolloutModel(vehicle, make_space(vehicle), rotor_input=False, voltage=False)
    begin = start_estimate(model, windows)
    linear = model.linearise(begin.theta, begin.free, windows, model.starts)
    noise = noise or measured_noise(linear.residual, linear.start_slope, windows)
    return gap_of(linear, windows, noise).rms, noise


def one(seed: list[int]) -> tuple[list[bool], list[str], str]:
    """Return whether the drag's intervals hold it, the false names, and a line for people.

    Raises:
        FlightFailed: where this draw cannot be flown.
    """
    rng = np.random.default_rng(seed)
    case = Case("outside", (), 0.0, "bare", "capture", (0, 0), simulator=CONTINUOUS)
    simulator = simulator_for(case, rng)
    drag = rng.uniform(0.15, 0.6, 3) * [1.0, 1.0, 0.5]
    truth = with_effects(simulator.given, {DRAG: EFFECTS[DRAG].values(tuple(drag.tolist()))})
    ways, law, chance = ordinary_flights(rng), force_law(rng), int(rng.integers(2**32))

    def logs(strength: float) -> tuple[FlightLog, ...]:
        again = np.random.default_rng(chance)
        extra = Push(strength, truth.mass, law)
        return simulator.fly(truth, ways, again, extra)(again)

    _, noise = gap_with(logs(0.0), truth, None)
    strength = FIRST * OFF / gap_with(logs(FIRST), truth, noise)[0]
    flown = logs(strength)
    off, _ = gap_with(flown, truth, noise)
    found = diagnosis_json(diagnose(flown, simulator.given))
    held, false = list[bool](), list[str]()
    for effect in found["effects"]:
        if DRAG not in (effect["name"], *effect["alternatives"]):
            false.append(effect["name"])
        if effect["name"] == DRAG:
            bounds = effect["parameters"]["coefficient"]["ci95"]
            held = [bool(b and b[0] <= x <= b[1]) for b, x in zip(bounds, drag, strict=True)]
    names = [effect["name"] for effect in found["effects"]]
    gap = found["gap"]
    line = f"{found['verdict']} {names}, drag held {held}, off by {off:.1f}"
    return held, false, f"{line}, gap {gap['before']:.1f} -> {gap['after']:.1f}"


def flyable(seed: list[int]) -> Iterator[tuple[list[bool], list[str], str]]:
    """Yield what `one` says of the first draw of this case that can be flown, if any."""
    keep_compiled()
    for attempt in range(TRIES):
        with contextlib.suppress(FlightFailed):
            yield one([*seed, attempt])
            return


def main(count: int, seed: int) -> int:
    """Try `count` cases, one a core, and return the exit code."""
    found = dict[int, tuple[list[bool], list[str], str]]()

    def keep(number: int, one: tuple[list[bool], list[str], str]) -> None:
        found[number] = one
        print(f"{number}: {one[-1]}", flush=True)

    cases = [[seed, number] for number in range(count)]
    run_pieces(flyable, cases, usable_cores(), keep, pinned=True)
    held = [hold for inside, _, _ in found.values() for hold in inside]
    flown, false = len(found), sum(bool(wrong) for _, wrong, _ in found.values())
    print(f"intervals of a named drag that hold it: {sum(held)} of {len(held)}", end=" ")
    print(f"({wilson(sum(held), max(len(held), 1))})" if held else "")
    print(f"cases with a false name: {false} of {flown} ({wilson(false, max(flown, 1))})")
    return 0 if sum(held) >= 0.85 * len(held) and false <= 0.1 * flown else 1


if __name__ == "__main__":
    one_thread_a_product()
    raise SystemExit(main(int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0))
