"""Measure whether the diagnosis finds nothing on clean flights, and effects that just matter.

    python tools/relevance.py [SETS [SEED [FIRST [TIMES]]]]

A set has four flights of `suite collect` with their own simulator, vehicle, track family, level,
row rate and noise, and commands or measured rotor speeds alone. It is diagnosed twice against the
vehicle that flew. First nothing is hidden: the verdict must be `no_gap`. Then one effect is hidden,
TIMES (1) the threshold of practical relevance (`Thresholds.relevance`): it must be named.
RotorPy's aerodynamics differ from the vehicle file. So its flights are diagnosed against the file
that describes them best, and nothing is hidden in them.

The tool prints a line for each set, with the size of the hidden effect in standard deviations of
its estimate: no method finds what is within the noise of a log. Then it prints the shares, with
their 95 % intervals (Clopper and Pearson): that of the named effects for each kind of log, among
all and among those that the log shows clearly (`Thresholds.visible_sigma`). 60 sets take about
30 minutes on one core.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tyro
from poseless import IDENTIFIABLE, hidden_values, outcome_of, share_line
from scipy.spatial.transform import Rotation

from eval.flights.simulate import SENSORS
from eval.logs.flight_log import FlightLog, read_flights
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import Vehicle, with_effects
from eval.worlds import nearest
from suite.blind.oracle import Column
from suite.common.console import Silent
from suite.common.startup import keep_compiled
from suite.diagnose.diagnose import Diagnosis, diagnose
from suite.diagnose.estimate.parameters import ParameterSpace
from suite.diagnose.evidence.rollouts import rollouts_along
from suite.diagnose.report.diagnosis_json import diagnosis_json
from suite.diagnose.thresholds import THRESHOLDS
from suite.diagnose.verdict.gap import rollout_size
from suite.judging.collect import collect
from suite.judging.requests import Collection
from tracks.families import FAMILIES

SIMULATORS = ("mujoco", "rotorpy", "mjx")
"""Simulators that record flights."""
VEHICLES = ("reference", "racer5")
"""Vehicle files without random effects."""
FLIGHTS = 4
"""Number of flights of a set."""
NOISE = SENSORS["full"]
"""Measurement noise of the noisy sets."""


class Setting(NamedTuple):
    """How the flights of a set are made."""

    collection: Collection
    """Policy, track, level, simulator and seed."""
    every: int
    """The log keeps one of so many rows; all rows are 100 a second."""
    noisy: bool
    """Whether the signals have measurement noise."""
    commands: bool
    """Whether the log has the commands."""

    @property
    def kind(self) -> str:
        """The input of the model that the log allows."""
        if not self.commands:
            return "with rotor speeds alone"
        return "with all commands" if self.every == 1 else "with every second command"


def draw(number: int, rng: np.random.Generator, seed: int) -> Setting:
    """Return the setting of set `number`."""
    collection = Collection(
        vehicle=str(rng.choice(VEHICLES)),
        simulator=SIMULATORS[number % len(SIMULATORS)],
        track=str(rng.choice(list(FAMILIES))),
        difficulty=str(rng.integers(0, 10)),
        trials=FLIGHTS,
        seed=seed + FLIGHTS * number,
    )
    return Setting(collection, int(rng.integers(1, 3)), *(bool(rng.integers(2)) for _ in range(2)))


def fly_logs(setting: Setting, vehicle: Vehicle, rng: np.random.Generator) -> list[FlightLog]:
    """Return the logs of the flights of `vehicle`; flights under one second have none."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save_vehicle(vehicle, folder / "vehicle.toml")
        flown = replace(setting.collection, vehicle=str(folder / "vehicle.toml"))
        listing = collect(flown, folder / "flights", Silent())
        files = [folder / "flights" / row["file"] for row in listing["flights"] if row["file"]]
        return [as_logged(log, setting, rng) for log in read_flights(files)[0]]


def as_logged(log: FlightLog, setting: Setting, rng: np.random.Generator) -> FlightLog:
    """Return `log` with the rows, the noise and the commands of the setting."""

    def noisy(values: np.ndarray, sigma: float) -> np.ndarray:
        kept = values[:: setting.every]
        return kept + setting.noisy * sigma * rng.standard_normal(kept.shape)

    def kept(values: np.ndarray | None) -> np.ndarray | None:
        return None if values is None or not setting.commands else values[:: setting.every]

    error = Rotation.from_rotvec(noisy(np.zeros((len(log.time_s), 3)), NOISE.attitude))
    attitude = Rotation.from_quat(log.quat_wxyz[:: setting.every], scalar_first=True)
    assert log.rotor_speed is not None
    return replace(
        log,
        time_s=log.time_s[:: setting.every],
        pos_w=noisy(log.pos_w, NOISE.pos),
        quat_wxyz=(attitude * error).as_quat(scalar_first=True),
        vel_w=noisy(log.vel_w, NOISE.vel),
        rate_b=noisy(log.rate_b, NOISE.gyro),
        rotor_speed=noisy(log.rotor_speed, NOISE.rotor),
        thrust_cmd=kept(log.thrust_cmd),
        rate_cmd_b=kept(log.rate_cmd_b),
        extra={},
    )


def at_threshold(
    name: str, values: Any, vehicle: Vehicle, logs: Sequence[FlightLog], times: float
) -> Any:
    """Return the effect's `values`, scaled to `times` the threshold of relevance on these flights.

    The size follows from the model's slopes along the flights. Force, torque and drift are divided
    by their thresholds, and the largest ratio becomes `times`.
    """
    by_rotors = logs[0].thrust_cmd is None
    model, windows, start = rollouts_along(logs, vehicle, rotor_input=by_rotors)
    space = model.space
    indices, change = _change(name, values, space, start.theta)
    slope = model.linearise(start, windows, indices).slope
    size = rollout_size(slope @ change, windows, by_rotors)
    shares = [(s or 0.0) / limit for s, limit in zip(size, THRESHOLDS.relevance, strict=True)]
    theta = start.theta.copy()
    theta[indices] += times * change / max(shares)
    return space.effects(theta)[name]


def in_deviations(name: str, values: Any, diagnosis: Diagnosis) -> float:
    """Return the change by the effect's `values` in standard deviations of its estimate.

    Other effects count as known, so it is an upper limit.
    """
    evaluation = diagnosis.main.source.begin
    indices, change = _change(name, values, evaluation.evidence.space, evaluation.at.theta)
    information, _ = evaluation.block.equations.take(indices).sums()
    return float(np.sqrt(change @ information @ change))


def _change(
    name: str, values: Any, space: ParameterSpace, theta: np.ndarray
) -> tuple[list[int], np.ndarray]:
    """Return the places of an effect's K parameters, and its `values` minus those of `theta`."""
    entries = {k: entry for k, entry in enumerate(space.entries) if entry.effect == name}
    columns = (Column(name, one.parameter, one.component or 0) for one in entries.values())
    target = np.array([column.value(values) for column in columns])
    return list(entries), target - theta[list(entries)]


def main(
    sets: tyro.conf.Positional[int] = 60,
    seed: tyro.conf.Positional[int] = 6_100_000,
    first: tyro.conf.Positional[int] = 0,
    times: tyro.conf.Positional[float] = 1.0,
) -> None:
    """Run the sets, and print a line for each and the shares."""
    keep_compiled()
    clean, named = 0, dict[str, list[tuple[bool, float]]]()
    for number in range(first, first + sets):
        rng = np.random.default_rng([seed, number])
        setting = draw(number, rng, seed)
        flown = load_vehicle(setting.collection.vehicle)
        effect = str(rng.choice(IDENTIFIABLE))
        values = hidden_values(effect, flown, rng)
        logs = fly_logs(setting, flown, rng)
        vehicle = nearest(setting.collection.simulator, flown)
        null = diagnosis_json(diagnose(logs, vehicle, seed=number))
        clean += null["verdict"] == "no_gap"
        line = f"{number:3d} {_words(setting)}: {_found(null)}"
        if vehicle is flown:
            hidden = at_threshold(effect, values, vehicle, logs, times)
            logs = fly_logs(setting, with_effects(flown, {effect: hidden}), rng)
            diagnosis = diagnose(logs, vehicle, seed=number)
            found = diagnosis_json(diagnosis)
            outcome = outcome_of(effect, found["effects"])
            size = in_deviations(effect, hidden, diagnosis)
            named.setdefault(setting.kind, []).append((outcome.startswith("named"), size))
            line += f" | {effect} of {size:.1f} sigma: {outcome}, {_found(found)}"
        print(line, flush=True)
    print(share_line("clean sets with the verdict no_gap", clean, sets))
    for kind, outcomes in named.items():
        what = f"effects of {times:g} times the threshold that are named, {kind}"
        least = THRESHOLDS.visible_sigma
        clear = [is_named for is_named, size in outcomes if size >= least]
        print(share_line(what, sum(is_named for is_named, _ in outcomes), len(outcomes)))
        print(share_line(f"of those of at least {least:g} sigma", sum(clear), len(clear)))


def _found(found: Any) -> str:
    """Return the verdict of a diagnosis and the effects that it names, as text."""
    names = [" or ".join([e["name"], *e["alternatives"]]) for e in found["effects"]]
    small = " ".join(entry["name"] for entry in found["negligible"])
    return f"{found['verdict']} {'; '.join(names)}{small and f' (too small: {small})'}"


def _words(setting: Setting) -> str:
    """Return the setting as text."""
    flown = setting.collection
    noise, drive = "noise" if setting.noisy else "exact", "cmd" if setting.commands else "rotors"
    where = f"{flown.simulator} {flown.vehicle} {flown.track} {flown.difficulty}"
    return f"{where} {100 // setting.every} Hz {noise} {drive}"


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        tyro.cli(main)
