"""The command `suite diagnose`: name the physical effects that a vehicle file lacks, from flights.

An effect is one physical cause of a mismatch between simulation and flights, such as drag.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from suite.common.console import Console
from suite.common.options import Advanced, Command
from tracks.common.files import check_no_input
from tracks.input.ranges import Range, Seed


@dataclass(frozen=True)
class Config(Command):
    """Find where flights and a vehicle file disagree, and name the missing effect."""

    flights: tyro.conf.Positional[tuple[Path, ...]]
    """Flight logs, or folders of them."""
    vehicle: str
    """The vehicle file that the simulation used, or a shipped vehicle's name."""
    reference: tuple[Path, ...] = ()
    """Earlier flights of the same vehicle, or folders of them: name what has changed since.
    Without it: name what the vehicle file lacks."""
    out: Path = Path("runs/diagnosis")
    """Folder for diagnosis.json, vehicle.toml, report.html and recording.rrd."""
    drive: Advanced[Literal["auto", "commands", "motors"]] = "auto"
    """Input of the model: logged commands or measured rotor speeds. auto takes measured speeds
    where real logs have them."""
    integrator: Advanced[Literal["auto", "continuous", "euler"]] = "auto"
    """How the flights were made: continuous (every real flight) or euler (MuJoCo's steps of the
    rate loop's period); auto reads it from the logs."""
    relevance: Advanced[Annotated[tuple[float, float, float], Range(0.0, 1e6)]] = (0.05, 0.5, 0.025)
    """Thresholds of practical relevance: force [m/s^2], torque over inertia [rad/s^2], drift after
    a second [m]. An effect below all three is left out. 0 0 0 reports everything significant."""
    compare_delta: Advanced[bool] = False
    """Also fit a Delta Action Model to the same flights, for comparison; takes minutes."""
    plan: bool = False
    """Also plan flights that separate the effects which these flights do not; in OUT/plan."""
    fly: Advanced[str | None] = None
    """With --plan: fly the plan in simulation with this vehicle (a file or a shipped name)."""
    no_recording: Advanced[bool] = False
    """Do not write recording.rrd (for rerun): the held-out flights, measured and simulated."""
    accept: Advanced[tuple[str, ...]] = ()
    """Continue in spite of these faults of the logs; the names are those that suite check
    prints."""
    seed: Advanced[Seed] = 0
    """Seed of the permutation test, the intervals and simulated noise."""

    LOCKED = ("out",)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Diagnose, and print the verdict, the named effects and the next steps.

    Raises:
        ValueError: for flights or a vehicle file that cannot be used.
    """
    from suite.delta.run import flight_files
    from suite.diagnose.report.summary import components, next_steps
    from suite.diagnose.run import diagnose_files

    check_no_input(config.out / "vehicle.toml", [config.vehicle, config.fly], "--out")
    for path in flight_files(config.flights) if config.fly or config.plan else ():
        check_no_input(config.out / "plan" / "flights" / path.name, [path], "--out")
    result = diagnose_files(
        config.flights,
        config.vehicle,
        config.out,
        console,
        drive=config.drive,
        integrator=config.integrator,
        compare_delta=config.compare_delta,
        plan=config.plan,
        fly=config.fly,
        recording=not config.no_recording,
        seed=config.seed,
        reference=config.reference,
        relevance=config.relevance,
        accept=config.accept,
    )
    console.say(f"verdict: {result['verdict']}")
    console.say(result["headline"])
    # The named effects, each with its parameters; significant ones first.
    for effect in result["effects"]:
        alternatives = ", ".join(effect["alternatives"])
        note = (
            f" (not distinguishable from {alternatives} on these flights)" if alternatives else ""
        )
        console.say(f"  {effect['name']}{note}")
        for component in sorted(
            components(effect), key=lambda component: not component.is_significant
        ):
            value, interval = component.texts()
            suffix = f", 95 %: {interval}" if interval else ""
            console.say(f"    {component.label}: {value}{suffix}")
    if result["warnings"]:
        console.say(f"warnings: {len(result['warnings'])}, printed above and in the report")
    for step in next_steps(result):
        console.say(f"next: {step}")
    # With --compare-delta: the gaps of the Delta Action Model, a model without physics.
    for flights_kind in ("held_out", "outside"):
        comparison = (result.get("black_box") or {}).get(flights_kind)
        if comparison:
            gap_with_names = comparison["named"]
            named_gap = f"{gap_with_names['gap']:.2f} with the names, " if gap_with_names else ""
            console.say(
                f"on {comparison['judged_on']}: {comparison['before']['gap']:.2f} before, "
                f"{named_gap}{comparison['black_box']['gap']:.2f} with a Delta Action Model"
            )
    plan = result.get("plan")
    if plan:
        count = len(plan["flights"])
        folder = f": {config.out / 'plan'}" if count else ""
        console.say(f"plan: {count} flights{folder}")
        if any(flight["flown"] for flight in plan["flights"]):
            console.say(f"flown in simulation: {config.out / 'plan' / 'flights'}")
    console.say(f"report: {config.out / 'report.html'}")
    return result
