"""Measure whether the diagnosis stays correct if no model of its catalogue can be right.

    python tools/misfit.py COUNT [SEED]

The diagnosis names physical effects that explain flights. Every case here has a hidden linear drag,
and a force field that no effect describes. The field is so strong that the error of a model with
the true drag is 20 times the noise. The tool runs one process for each core, and prints a line for
each case. Then it prints how many 95 % intervals of the drag contain the true value, and in how
many cases an effect is named that is not there.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import numpy as np
import tyro

from eval.effects import EFFECTS
from eval.flights.follow import FlightFailed
from eval.flights.trajectory import ordinary_flights
from eval.judging.statistics import wilson, wilson_by_group
from eval.logs.flight_log import FlightLog
from eval.quadrotor.plant import Motion, Wrench
from eval.vehicles.vehicle import Vehicle, with_effects
from suite.blind.build import Simulator
from suite.blind.cases import CONTINUOUS, Case
from suite.blind.outside import Law, Outside
from suite.common.startup import keep_compiled
from suite.diagnose.data.noise import Noise, measured_noise
from suite.diagnose.diagnose import diagnose
from suite.diagnose.evidence.rollouts import rollouts_along
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.verdict.gap import gap_of
from tracks.common.work import run_pieces, usable_cores
from tracks.common.work.threads import one_thread_a_product

TARGET_ERROR = 20.0
"""Rollout error of a model with the true drag, in units of the noise."""
DRAG = "linear_drag"
"""The hidden effect."""
WAVES = 3
"""Number of sine waves in the force field along each axis."""
LENGTH_M = (3.0, 10.0)
"""Shortest and longest wavelength [m]."""
FIRST_STRENGTH = 0.3
"""Root mean square of the force field along each axis in the first flights of a case, from which
the final strength is computed [m/s^2]."""
TRIES = 8
"""Largest number of draws of a case; one is valid if all flights succeed."""

Outcome = tuple[list[bool], list[str], str]
"""For each component of a named drag, whether the interval contains the true value; the false
names; and a line to print."""


def force_law(rng: np.random.Generator) -> Law:
    """Return a smooth force field of the position; `strength` is its RMS along each axis."""
    wave_vector = rng.standard_normal((3, WAVES, 3))
    length_m = rng.uniform(*LENGTH_M, (3, WAVES, 1))
    wave_vector *= 2.0 * np.pi / length_m / np.linalg.norm(wave_vector, axis=-1, keepdims=True)
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, WAVES))
    amplitude = rng.standard_normal((3, WAVES))
    amplitude *= np.sqrt(2.0 / (amplitude**2).sum(axis=1, keepdims=True))

    def law(strength: float, mass: float, motion: Motion, wrench: Wrench, t: float) -> np.ndarray:
        """Return the acceleration (N, 3) at the present positions [m/s^2]."""
        angle = np.einsum("akw,nw->nak", wave_vector, motion.pos_w)
        return strength * (amplitude * np.sin(angle + phase)).sum(axis=-1)

    return law


def rollout_error(
    logs: Sequence[FlightLog], vehicle: Vehicle, noise: Noise | None
) -> tuple[float, Noise]:
    """Return the rollout error of `vehicle` along `logs` in units of the noise, and the noise.

    If `noise` is None, it is measured on these logs.
    """
    model, windows, start = rollouts_along(logs, vehicle, rotor_input=False)
    linear = model.linearise(start, windows, model.starts)
    noise = noise or measured_noise(linear)
    return gap_of(linear, noise).rms, noise


def run_case(seed: list[int]) -> Outcome:
    """Fly and diagnose one case.

    Raises:
        FlightFailed: if a flight of this draw fails.
    """
    rng = np.random.default_rng(seed)
    case = Case("outside", (), 0.0, "bare", "capture", (0, 0), simulator=CONTINUOUS)
    simulator = Simulator(case, rng)
    drag = rng.uniform(0.15, 0.6, 3) * [1.0, 1.0, 0.5]
    truth = with_effects(simulator.nominal, {DRAG: EFFECTS[DRAG].values(tuple(drag.tolist()))})
    trajectories, law = ordinary_flights(rng), force_law(rng)
    flight_seed = int(rng.integers(2**32))

    def fly_logs(strength: float) -> tuple[FlightLog, ...]:
        """Return the logs of the flights with a field of this strength; the noise is the same."""
        flight_rng = np.random.default_rng(flight_seed)
        extra = Outside(strength, truth.mass, law)
        return simulator.fly(truth, trajectories, flight_rng, extra)(flight_rng)

    # The noise is measured without the field. The error grows with the strength of the field, so
    # one flight gives the strength for the wanted error.
    _, noise = rollout_error(fly_logs(0.0), truth, None)
    first_error, _ = rollout_error(fly_logs(FIRST_STRENGTH), truth, noise)
    logs = fly_logs(FIRST_STRENGTH * TARGET_ERROR / first_error)
    error, _ = rollout_error(logs, truth, noise)
    diagnosis = diagnosis_json(diagnose(logs, simulator.nominal))
    covered, false = list[bool](), list[str]()
    for effect in diagnosis["effects"]:
        if DRAG not in (effect["name"], *effect["alternatives"]):
            false.append(effect["name"])
        if effect["name"] == DRAG:
            bounds = effect["parameters"]["coefficient"]["ci95"]
            covered = [bool(b and b[0] <= x <= b[1]) for b, x in zip(bounds, drag, strict=True)]
    names = [effect["name"] for effect in diagnosis["effects"]]
    gap = diagnosis["gap"]
    line = f"{diagnosis['verdict']} {names}, drag covered {covered}, error {error:.1f}"
    return covered, false, f"{line}, gap {gap['before']:.1f} -> {gap['after']:.1f}"


def first_valid_draw(seed: list[int]) -> Iterator[Outcome]:
    """Yield the outcome of the first draw of a case whose flights succeed; nothing if none does."""
    keep_compiled()
    for attempt in range(TRIES):
        with contextlib.suppress(FlightFailed):
            yield run_case([*seed, attempt])
            return


def main(count: tyro.conf.Positional[int], seed: tyro.conf.Positional[int] = 0) -> int:
    """Run `count` cases, one process for each core, and return the exit code."""
    outcomes = dict[int, Outcome]()

    def keep(number: int, outcome: Outcome) -> None:
        outcomes[number] = outcome
        print(f"{number}: {outcome[-1]}", flush=True)

    cases = [[seed, number] for number in range(count)]
    run_pieces(first_valid_draw, cases, usable_cores(), keep, pinned=True)
    by_case = [intervals for intervals, _, _ in outcomes.values()]
    covered = [inside for intervals in by_case for inside in intervals]
    total, false = len(outcomes), sum(bool(names) for _, names, _ in outcomes.values())
    print(f"intervals of a named drag that contain it: {sum(covered)} of {len(covered)}", end=" ")
    print(f"({wilson_by_group(by_case)})" if covered else "")
    print(f"cases with a false name: {false} of {total} ({wilson(false, max(total, 1))})")
    return 0 if sum(covered) >= 0.85 * len(covered) and false <= 0.1 * total else 1


if __name__ == "__main__":
    one_thread_a_product()
    raise SystemExit(tyro.cli(main))
