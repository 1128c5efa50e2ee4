"""The settings of a loop, computed from a recipe and the options.

The true vehicle produces the flights; without a hidden vehicle it is that of the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.sensors_file import SensorSet, load_sensors, sensors_table
from eval.vehicles.vehicle import Vehicle
from eval.worlds import world_class
from policies import shipped
from policies.formats.policy_file import load_policy_checkpoint
from suite.delta.fit import FitConfig
from suite.diagnose.estimate.parameters import refuse_own_motion
from suite.judging.content import policy_digest
from suite.judging.flying import checkpoint_folder, default_policy
from suite.judging.trials import is_track_file, parse_levels, parse_tracks
from suite.loop.options import Config
from suite.train.config import TrainConfig, check
from suite.train.overrides import at_rate, check_owned, check_phases, phase_configs, with_changes
from suite.train.recipes import (
    finetune,
    named_recipe,
    with_iterations,
    with_quadrotor,
    with_usual_spreads,
)
from tracks.common.files import digest_of
from tracks.input.ranges import SEED_MOST, Iterations, Range, Trials, check_ranges

RECORDED_FROM = 100_000
"""Seed of the first recorded flight minus that of the first judged trial. It is so large that no
flight is recorded on the track of a trial."""
EXACT_SIMULATORS = ("mujoco", "mjx")
"""Simulators that fly a vehicle exactly as its file describes; the first is the default."""
LOOP_SEEDS = Range(0, SEED_MOST - 10 * RECORDED_FROM)
"""Allowed seeds of a loop. The seeds of its fine-tunings and recorded flights are larger, and must
be allowed as well."""


@dataclass(frozen=True)
class LoopSize:
    """Numbers of trials, flights and gradient steps of a loop."""

    trials: Trials
    """Judged trials of each policy on every track at every level."""
    flights: Trials
    """Recorded flights on every track at every level."""
    fit_iterations: Iterations
    """Gradient steps of the fit of a Delta Action Model."""
    finetune_iterations: Iterations | None = None
    """Gradient steps of each fine-tuning; None: a share of those of the training."""


SIZES = {"quick": LoopSize(20, 8, 500), "": LoopSize(50, 20, 1500)}
"""Sizes of a loop by recipe; "" is that of all other recipes."""
HIDDEN_SIZE = LoopSize(25, 3, 200, 60)
"""Size of a loop with a hidden vehicle."""


@dataclass(frozen=True)
class LoopConfig:
    """Settings of a loop, with a hidden vehicle or without one."""

    training: TrainConfig
    """Settings of the first training, if no policy is given. Without a hidden vehicle the Delta
    Action Model corrects its dynamics: the point mass or a quadrotor."""
    tuning: TrainConfig
    """Settings of the fine-tunings, which differ only in their dynamics."""
    fit: FitConfig
    """Settings of the fits of Delta Action Models."""
    policy: str | None
    """The policy to start from: a shipped name or a checkpoint's folder; None trains one."""
    track: str
    """Families of tracks, such as "zigzag,circular"; see `suite.judging.trials.parse_tracks`."""
    difficulty: str
    """Levels, such as "0,3"; see `suite.judging.trials.parse_levels`."""
    trials: Trials
    """Judged trials of each policy on every track at every level."""
    flights: Trials
    """Recorded flights on every track at every level."""
    vehicle: str
    """The nominal vehicle of the simulation: a shipped name or a vehicle file."""
    sensors: str
    """Sensor errors in what policies see, in every flight: a shipped name or a sensors file."""
    seed: Annotated[int, LOOP_SEEDS]
    """Seed of the trainings and of the first judged trial."""
    digests: dict[str, str]
    """SHA-256 of the vehicles, the sensors and the given policy (if there is one), by name."""
    hidden_vehicle: str | None = None
    """The true vehicle's file, if it is another than the simulation's; the loop uses only its
    flights."""
    simulator: str = EXACT_SIMULATORS[0]
    """The simulator of the true vehicle."""
    delta: bool = True
    """Whether Delta Action Models are fitted, and policies are fine-tuned with them."""

    @property
    def recorded_from(self) -> int:
        """Seed of the first recorded flight."""
        return self.seed + RECORDED_FROM

    def check_files(self) -> None:
        """Refuse files that have changed since the loop began.

        Raises:
            ValueError: naming what has changed.
        """
        true = load_vehicle(self.hidden_vehicle) if self.hidden_vehicle else None
        digests = _digests(load_vehicle(self.vehicle), load_sensors(self.sensors), true)
        for name, digest in digests.items():
            if digest != self.digests[name]:
                raise ValueError(
                    f"the file of --{name.replace('_', '-')} has changed since the loop began, so "
                    "its results could not be compared; restore the file, or give another --out"
                )

    @property
    def cells(self) -> int:
        """Number of cells, the pairs of track and level."""
        return len(parse_tracks(self.track)) * len(parse_levels(self.difficulty))

    @property
    def true_vehicle(self) -> str:
        """The vehicle that flies trials and recorded flights: a shipped name or a vehicle file."""
        return self.vehicle if self.hidden_vehicle is None else self.hidden_vehicle


def loop_by_content(config: LoopConfig) -> LoopConfig:
    """Return the settings without paths of files, whose content is in `digests`.

    So a loop can be continued from another folder or machine. If a name is that of a file as well
    as of something shipped, it means the shipped policy, or the vehicle file, as in loading.
    """

    def without_path(name_or_path: str) -> str:
        return "a file" if Path(name_or_path).is_file() else name_or_path

    policy = config.policy
    if policy is not None and policy not in shipped.names():
        policy = "a file"
    vehicle, sensors = without_path(config.vehicle), without_path(config.sensors)
    hidden = config.hidden_vehicle and without_path(config.hidden_vehicle)
    return replace(config, policy=policy, vehicle=vehicle, sensors=sensors, hidden_vehicle=hidden)


def resolve(options: Config) -> LoopConfig:
    """Return the settings of a loop from its options.

    Numbers that are None are those of the loop's size (`SIZES`, `HIDDEN_SIZE`). Without a recipe it
    is that of the policy. With a hidden vehicle or another simulator nothing is trained from
    scratch, and the default policy is the shipped one. With a policy, `--set` changes its
    fine-tuning, else the recipe.

    Raises:
        ValueError: for an invalid option, with what is allowed.
    """

    def given(value: Any, otherwise: Any) -> Any:
        """Return the value of an option if there is one."""
        return otherwise if value is None else value

    # The kind of loop, its recipe and its size.
    simulator, hidden_vehicle = options.simulator, options.hidden_vehicle
    hidden = hidden_vehicle is not None or simulator != EXACT_SIMULATORS[0]
    policy = default_policy() if hidden and options.policy is None else options.policy
    recipe = given(options.recipe, policy if policy in shipped.names() else "race")
    training = replace(named_recipe(recipe), seed=options.seed)
    size = HIDDEN_SIZE if hidden else SIZES.get(recipe, SIZES[""])
    if options.iterations is not None:
        training = with_iterations(training, options.iterations)
    # The simulation's vehicle, and options that contradict each other.
    simulated = load_vehicle(options.vehicle)
    _check_changes(options.set, policy, options.iterations)
    if options.no_delta and not hidden:
        raise ValueError(
            "--no-delta: without --hidden-vehicle the loop needs the Delta Action Model; leave "
            "--no-delta out, or give a hidden vehicle"
        )
    if options.no_delta and options.fit_iterations is not None:
        raise ValueError(
            f"--fit-iterations is {options.fit_iterations}, but with --no-delta no Delta Action "
            "Model is fitted; leave one of the two out"
        )
    if not hidden and policy is None:
        training = with_changes(training, options.set)
        check_phases(training)
    # The true vehicle, which must differ from the simulation's.
    true, true_vehicle = None, options.vehicle if hidden_vehicle is None else hidden_vehicle
    if hidden:
        refuse_own_motion(simulated)
        world_class(simulator)
        true = load_vehicle(true_vehicle)
        if simulated == replace(true, name=simulated.name) and simulator in EXACT_SIMULATORS:
            raise ValueError(
                f"--hidden-vehicle {true_vehicle} is the simulation's vehicle {options.vehicle}: "
                "nothing is hidden; give a vehicle file with one more effect, such as "
                "examples/hidden.toml, or another simulator, such as --simulator rotorpy"
            )
    digests = _digests(simulated, load_sensors(options.sensors), true)
    # The settings of the fine-tuning.
    if policy is not None:
        spec = load_policy_checkpoint(checkpoint_folder(policy)).spec
        last = phase_configs(training)[-1]
        training = replace(at_rate(last, spec.rate_hz), spec=spec)
        digests["policy"] = policy_digest(policy)
    tuning = finetune(training)
    steps = given(options.finetune_iterations, size.finetune_iterations)
    if steps is not None:
        tuning = with_iterations(tuning, steps)
    if hidden:
        tuning = with_usual_spreads(with_quadrotor(tuning, simulated))
    if policy is not None:
        tuning = with_changes(tuning, options.set)
    check(tuning)
    config = LoopConfig(
        training=training,
        tuning=tuning,
        fit=FitConfig(
            iterations=given(options.fit_iterations, size.fit_iterations), seed=options.seed
        ),
        policy=policy,
        track=options.track,
        difficulty=options.difficulty,
        trials=given(options.trials, size.trials),
        flights=given(options.flights, size.flights),
        vehicle=options.vehicle,
        sensors=options.sensors,
        seed=options.seed,
        digests=digests,
        hidden_vehicle=true_vehicle if hidden else None,
        simulator=simulator,
        delta=not options.no_delta,
    )
    check_ranges(config)
    _check_seeds(config)
    return config


def _digests(vehicle: Vehicle, sensors: SensorSet, true: Vehicle | None) -> dict[str, str]:
    """Return the SHA-256 of the contents of the files, by option; `true` is a hidden vehicle."""
    digests = {"vehicle": digest_of(vehicle), "sensors": digest_of(sensors_table(sensors))}
    return digests | ({} if true is None else {"hidden_vehicle": digest_of(true)})


def _check_changes(changes: Sequence[str], policy: str | None, iterations: int | None) -> None:
    """Refuse options of a first training if there is none, and settings that the loop sets."""
    owned = {"seed": "give --seed"}
    if policy is None:
        owned["optimizer.iterations"] = "give --iterations"
    else:
        owned["optimizer.iterations"] = "give --finetune-iterations"
        owned["spec"] = "a policy keeps the spec that it was trained with"
        if iterations is not None:
            raise ValueError(
                f"--iterations is {iterations}, but with --policy, --hidden-vehicle or "
                "--simulator nothing is trained from scratch; give --finetune-iterations, the "
                "number of fine-tuning steps"
            )
    check_owned(changes, owned)


def _check_seeds(config: LoopConfig) -> None:
    """Refuse tracks that no trial of a loop may have, and too few flights.

    On track files recorded flights would equal trials. On the random family policies train.
    """
    tracks = parse_tracks(config.track)
    if "random" in tracks:
        raise ValueError(
            "--track random: the fine-tunings train on this family, so they are judged on others; "
            "give families of zigzag, circular and ellipse"
        )
    files = [name for name in tracks if is_track_file(name)]
    if files:
        raise ValueError(
            f"--track {files[0]}: a track from a file is the same at every seed, so recorded "
            "flights and judged trials would be the same; give families (zigzag, circular, ellipse)"
        )
    if config.flights * config.cells < 2:
        raise ValueError(
            f"--flights is {config.flights} on {config.cells} track and level; at least 2 flights "
            "are needed, one of which is held out"
        )
