"""Loops on vehicles that hide an effect: what diagnosis and Delta Action Models regain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple

from eval.effects import EFFECTS
from eval.judging.results import read_trials
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle, shipped_vehicles
from eval.vehicles.vehicle import Vehicle, with_effects
from policies import shipped
from suite.common.console import Console
from suite.common.errors import WorkFailed
from suite.common.running.apart import Job
from suite.common.work import all_done
from suite.experiments.pages import hidden_vehicles as pages
from suite.experiments.pages.document import Made, Place
from suite.experiments.pages.hidden_vehicles import Came
from suite.experiments.study import judging, options
from suite.experiments.study.cache import LOOP_ROOMS, code_digest, digest, engines
from suite.judging.content import policy_digest
from suite.judging.flying import checkpoint_folder, default_policy
from suite.loop.config import HiddenLoopConfig, resolve
from suite.loop.hidden_effect import LABELS, MODELS
from suite.loop.run import run_loop
from suite.loop.work import read_diagnosis
from suite.train.overrides import check_owned
from tracks.common.names import unknown_name
from tracks.input.ranges import SEED_MOST, Iterations, Range, Trials
from tracks.input.reading import read_json

ROOMS = (*LOOP_ROOMS, "suite/diagnose")
"""Code whose change makes every loop anew."""
APART = 1000
"""The loops' seeds lie so far apart, so that no two of them judge the same trials."""
TRAINING_SEED_MOST = 500
"""Training seeds go up to this."""


class Hidden(NamedTuple):
    """A world that hides something."""

    words: str
    """What, for people."""
    effects: Mapping[str, Mapping[str, Any]]
    """Parameters by effect, added to the vehicle that the simulation knows."""


WORLDS: dict[str, Hidden] = {
    "heavy battery": Hidden(
        "0.4 kg more, and the centre of mass 8 mm further back",
        {"mass_offset": {"offset": 0.4}, "com_offset": {"offset": (-0.008, 0.0, 0.0)}},
    ),
    "moved centre of mass": Hidden(
        "12 mm ahead and 4 mm to the left", {"com_offset": {"offset": (0.012, 0.004, 0.0)}}
    ),
    "weak rotor": Hidden(
        "rotor 1 gives 70 % of its thrust", {"weak_motor": {"scale": (0.7, 1.0, 1.0, 1.0)}}
    ),
    "drag and wind": Hidden(
        "linear drag of 0.7, 0.7 and 1.2 1/s, in a wind of 5 m/s",
        {
            "linear_drag": {"coefficient": (0.7, 0.7, 1.2)},
            "constant_wind": {"velocity": (-3.0, 4.0, 0.0)},
        },
    ),
    "long delay": Hidden("commands act after 85 ms", {"command_delay": {"delay": 0.085}}),
}
"""By name."""


@dataclass(frozen=True)
class Config:
    """Run `suite loop --world` in worlds that hide an effect, and report what regains success.

    From every seed the same policy is fine-tuned anew in every world: as a control, with a Delta
    Action Model, with the effect that the diagnosis names, and with both.
    """

    policy: str | None = None
    """A shipped policy's name or a checkpoint's folder; by default the shipped."""
    only: tuple[str, ...] = ()
    """Only these worlds, by name; by default all."""
    training_seeds: tuple[Annotated[int, Range(0, TRAINING_SEED_MOST)], ...] = (0, 1, 2)
    """One loop each: flights, noise, fits and fine-tunings differ."""
    difficulty: str = "3,9"
    """Level, 0 (easy) to 9 (hard); several as 0,3,9 or 0-3 or all."""
    trials: Annotated[int, Range(1, APART)] = 10
    """Judged trials of each policy on every track at every level, for every training seed."""
    flights: Trials = 3
    """Recorded flights on every track at every level, for every training seed."""
    iterations: Iterations = 60
    """Gradient steps of each fine-tuning."""
    fit_iterations: Iterations = 200
    """Gradient steps of the fit of each Delta Action Model."""
    set: tuple[str, ...] = ()
    """Change settings of the fine-tuning by name."""
    seed: Annotated[int, Range(0, SEED_MOST - APART * (TRAINING_SEED_MOST + 1))] = 0
    """Seed of the first judged trial of training seed 0; those of training seed K are 1,000 K
    above."""
    vehicle: str = "reference"
    """What the simulation knows: a shipped vehicle's name or a vehicle file (.toml)."""


class Asked(NamedTuple):
    """One loop."""

    config: Config
    world: str
    training_seed: int
    simulated: Vehicle
    """What the simulation knows, by content: the loop may run where there are none of our files."""


def document(config: Config, place: Place, console: Console) -> Made:
    """Return tables and numbers; loops that are missing are run first."""
    simulated = load_vehicle(config.vehicle)
    policy = config.policy or default_policy()
    config = replace(config, policy=policy)
    owned = {"optimizer.iterations": "give --iterations", "seed": "give --training-seeds"}
    check_owned(config.set, owned)
    for name in config.only:
        if name not in WORLDS:
            raise unknown_name("hidden vehicle", name, WORLDS)
    worlds = {name: hidden for name, hidden in WORLDS.items() if name in (config.only or WORLDS)}
    start = None if policy in shipped.names() else checkpoint_folder(policy)
    jobs = []
    for seed in config.training_seeds:
        for name, hidden in worlds.items():
            true = world_of(simulated, hidden)
            # Where files lie makes no other loop; a shipped policy's name is its recipe.
            shown = policy if start is None else ""
            asked = replace(config, policy=shown, vehicle="", only=(), training_seeds=(seed,))
            made_of = [asked, policy_digest(policy), simulated, true]
            about = [*made_of, code_digest(*ROOMS), engines()]
            folder = place.cache / "loops" / f"{name.replace(' ', '-')}-{seed}-{digest(about)}"
            jobs.append(Job(Asked(config, name, seed, simulated), folder, start))
    loop_of(jobs[0])
    came = all_done(run_one, jobs, place.workers, console, "loops in hidden vehicles")
    rows, words = pages.rows_of(came), {name: hidden.words for name, hidden in worlds.items()}
    facts = {
        **judging.policy_facts({"policy": policy}),
        "simulation's vehicle": config.vehicle,
        "training seeds": " ".join(map(str, config.training_seeds)),
        "trials": f"three tracks, levels {config.difficulty}: "
        f"{len(judging.trials_of(config))} of each policy for each training seed, seeds "
        + ", ".join(
            options.judged_seeds(replace(config, seed=config.seed + APART * seed))
            for seed in config.training_seeds
        ),
        "recorded": f"{config.flights} flights on every track and level, at other seeds",
        "fine-tuning": f"{config.iterations} gradient steps each",
    }
    parts = {
        **pages.by_world(rows),
        "What is hidden, and what is named": [pages.named_grid(came, words)],
        "Errors of the Delta Action Models": [pages.errors_grid(came)],
    }
    numbers = {
        "worlds": [row._asdict() for row in rows],
        "diagnoses": [{**_whose(one), **one.diagnosis} for one in came],
        "errors": [{**_whose(one), **one.errors} for one in came],
    }
    return Made(facts, parts, numbers)


def _whose(one: Came) -> dict[str, Any]:
    return {"world": one.world, "training_seed": one.training_seed}


def world_of(simulated: Vehicle, hidden: Hidden) -> Vehicle:
    """Return what flies there."""
    values = {name: EFFECTS[name].values(**given) for name, given in hidden.effects.items()}
    return with_effects(simulated, values)


def loop_of(job: Job) -> HiddenLoopConfig:
    """Return the loop of a job's `Asked`, having written its vehicles' files.

    Raises:
        ValueError: for an option that cannot be used.
    """
    config, name, seed, simulated = job.task
    path, vehicle, hidden = job.folder / "world.toml", config.vehicle, WORLDS[name]
    try:
        save_vehicle(world_of(simulated, hidden), path, hidden.words)
    except ValueError as error:
        raise ValueError(
            f"hidden vehicle {name!r} cannot be made of --vehicle {vehicle}: {error}; leave it "
            "out by naming others with --only, or give another vehicle"
        ) from error
    if vehicle not in shipped_vehicles():
        vehicle = str(job.folder / "vehicle.toml")
        save_vehicle(simulated, vehicle, "what the simulation knows")
    loop = resolve(
        hidden_vehicle=str(path),
        policy=config.policy if job.reads is None else str(job.reads),
        difficulty=config.difficulty,
        trials=config.trials,
        flights=config.flights,
        vehicle=vehicle,
        seed=config.seed + APART * seed,
        finetune_iterations=config.iterations,
        fit_iterations=config.fit_iterations,
        changes=config.set,
    )
    assert isinstance(loop, HiddenLoopConfig)
    return loop


def run_one(job: Job, console: Console) -> Came:
    """Run the loop of a job's `Asked`, or what is left of it, in the job's folder."""
    out = job.folder / "loop"
    try:
        run_loop(loop_of(job), out, console)
    except WorkFailed:
        # A loop whose diagnosis names nothing ends there, and that is a result.
        if not (out / "diagnosis" / "stage.json").is_file() or read_diagnosis(out)["effects"]:
            raise
    found = read_diagnosis(out)
    paths = {name: out / f"eval-{name}" / "trials.parquet" for name in LABELS}
    errors = {}
    for variant, whose in MODELS.items():
        path = out / f"delta-{variant}" / "delta.json"
        if path.is_file():
            fitted = read_json(path)
            errors[f"{whose} quadrotor"] = fitted["without"]["position_m"]
            errors[f"{whose} quadrotor with delta"] = fitted["delta_action"]["position_m"]
    judged = {name: read_trials(path) for name, path in paths.items() if path.is_file()}
    named = {key: found[key] for key in ("verdict", "effects", "gap")}
    return Came(job.task.world, job.task.training_seed, judged, named, errors)
