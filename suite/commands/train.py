"""The command `suite train`: train a policy by backpropagation through differentiable dynamics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from suite.commands.list import list_settings
from suite.common.console import Console, Silent, command_line, counted
from suite.common.curve import tensorboard
from suite.common.options import Advanced, Command
from suite.common.running.hosts import ProcessOptions, connect, read_member
from suite.common.stages import differences, first_changes
from suite.common.startup import use_device
from suite.common.vehicles import camera_warnings
from suite.train.config import TrainConfig
from suite.train.overrides import (
    PREFIX,
    check_owned,
    check_phases,
    phase_configs,
    with_changes,
)
from suite.train.recipes import finetune, named_recipe, with_model, with_sensors
from tracks.common.files import check_no_input, plain
from tracks.input.ranges import Iterations, Range, Seed


@dataclass(frozen=True)
class Config(Command):
    """Train a policy; the same command again resumes an interrupted training."""

    recipe: str = "race"
    """The settings to start from: race (makes the default policy, two hours on one core),
    race-small (a small network), race-paper (the paper's 12 state inputs, through the point mass),
    quick (6 minutes), paper (the paper's settings, days) or gpu (2,048 environments)."""
    model: Literal["point", "quad"] | None = None
    """The dynamics of the training: the point mass, or the quadrotor of --vehicle with its effects.
    Without it those of the recipe."""
    vehicle: str | None = None
    """Train with quadrotors around this vehicle: a shipped name or a vehicle file (.toml). Without
    it around racer5. A recipe with the point mass (quick) needs --model quad as well."""
    sensors: str | None = None
    """Train with sensor errors: a shipped name (vio, gate-relative, stereo-depth, all, ...) or a
    sensors file (.toml). Without it sensors are perfect. Each environment draws the magnitude of
    every error evenly from 0 to 1; --set sensors.magnitude=(0,1.5) draws it up to 1.5."""
    out: Path = Path("runs/train")
    """Folder of the run; an unfinished run in it is resumed."""
    seed: Seed = 0
    """Seed of the parameters, the tracks and the randomisation."""
    iterations: Iterations | None = None
    """Gradient steps, instead of the recipe's."""
    num_envs: Annotated[int, Range(1, 10**6)] | None = None
    """Environments per gradient step, instead of the recipe's; the same as --set episode.batch."""
    lr: Annotated[float, Range(0.0, 10.0, above=True)] | None = None
    """Peak learning rate of every phase, instead of the recipe's; the same as --set
    optimizer.rate."""
    device: Literal["cpu", "gpu"] | None = None
    """The device that computes. Without it a GPU if JAX finds one, else the CPU."""
    init_from: str | None = None
    """Start from this policy instead of random weights: a checkpoint's folder or a shipped
    policy's name (race-small needs --recipe race-small)."""
    finetune: bool = False
    """Fine-tune the policy of --init-from: the recipe's last phase alone, a quarter of its gradient
    steps, 0.3 times its learning rate."""
    delta: Advanced[Path | None] = None
    """Correct the actions by this Delta Action Model (the --out of `suite delta`), which is not
    trained."""
    set: tuple[str, ...] = ()
    """Change settings by name, in every phase, such as loss.progress=0.4; from the second phase
    until a later one changes it: phases.2.loss.progress=0.4. A new spec.rate_hz also changes
    episode.steps, so that rollouts last as long as before."""
    tensorboard: Advanced[bool] = False
    """Also write the curve for TensorBoard, into tensorboard/ of the run (extra `tensorboard`)."""
    list_settings: bool = False
    """Print every setting that --set takes, with value, range and meaning, and train nothing."""
    process_options: Advanced[ProcessOptions] = ProcessOptions()
    """The place of this process among several."""

    def written(self) -> list[Path]:
        """Return the folders that this command writes; while it runs, no other may write there.

        Of several processes only the first one writes.
        """
        is_first = read_member(self.process_options).number == 0
        return [self.out] if is_first and not self.list_settings else []


def resolve(config: Config) -> TrainConfig:
    """Return the configuration of the training that the options describe.

    Later steps override earlier ones: recipe, model, fine-tuning, sensors, options and changes.

    Raises:
        ValueError: with what is allowed, for an unknown recipe, setting or vehicle, a setting given
            twice, or a vehicle for a recipe that trains the point mass.
    """
    options = (
        ("episode.batch", "--num-envs", config.num_envs),
        ("optimizer.rate", "--lr", config.lr),
        ("optimizer.iterations", "--iterations", config.iterations),
    )
    given = [option for option in options if option[2] is not None]
    check_owned(
        [change for change in config.set if not change.strip().startswith(PREFIX)],
        {"seed": "give --seed"}
        | {path: f"leave out {name} or this change" for path, name, _ in given},
    )
    run = replace(named_recipe(config.recipe), seed=config.seed)
    run = with_model(run, config.model, config.vehicle)
    if config.finetune:
        if config.init_from is None:
            raise ValueError("--finetune needs --init-from: the policy to fine-tune")
        run = replace(finetune(run), seed=config.seed)
    if config.sensors is not None:
        run = with_sensors(run, config.sensors)
    changes = [f"{path}={value}" for path, _, value in given]
    run = with_changes(run, [*changes, *config.set])
    check_phases(run)
    return run


def doubts(resolved: TrainConfig, changes: Sequence[str], anew: str = "") -> list[str]:
    """Return warnings about settings that are probably mistakes.

    `changes` are those of --set. `anew` follows the advice on another camera.
    """
    from eval.logs.faults.vehicle import narrow_view
    from suite.train.run import change_warnings, rate_loop_warnings, warmup_warnings

    warnings = [*change_warnings(resolved, changes), *warmup_warnings(resolved)]
    warnings += rate_loop_warnings(resolved)
    if text := narrow_view(resolved.spec.camera.fov_deg):
        text = f"the policy: {text}; spec.camera.fov_deg is in degrees, not radians"
        warnings = [text, *warnings]
    if resolved.quadrotor is None:
        return warnings
    vehicle = resolved.quadrotor.vehicle
    pitch, (wide, high) = vehicle.camera.pitch_deg, vehicle.camera.fov_deg
    advice = f"--set spec.camera.pitch_deg={pitch:g} spec.camera.fov_deg={wide:g},{high:g}"
    advice = f"to train with the vehicle's, give {advice}{anew}"
    return warnings + camera_warnings(resolved.spec.camera, vehicle, advice)


def run(config: Config, console: Console) -> dict[str, Any]:
    """Train a policy; print its folder and the last row of the curve."""
    if config.list_settings:
        return {"settings": list_settings(resolve(config), console)}
    member = read_member(config.process_options)
    use_device(config.device)
    connect(member)
    if member.number:  # of several processes only the first one prints
        console = Silent()

    import jax

    from policies.formats.checkpoint import CONFIG
    from policies.formats.policy_file import load_delta, load_policy_checkpoint
    from suite.common.provenance import refuse_policy_folder
    from suite.delta.replay import check_corrects
    from suite.judging.flying import checkpoint_folder
    from suite.train.run import start_params, train

    resolved = resolve(config)
    refuse_policy_folder(config.out)
    anew = "" if config.init_from is None else " and leave --init-from out"
    for warning in doubts(resolved, config.set, anew):
        console.note(f"warning: {warning}")
    params, delta = None, None
    if config.init_from is not None:
        # The trained policy goes to out/policy, which must not be the one to start from.
        folder, phases = checkpoint_folder(config.init_from, "--init-from"), phase_configs(resolved)
        check_no_input(config.out / "policy" / CONFIG, [folder / CONFIG])
        start = load_policy_checkpoint(folder)
        for note in start.notes(config.init_from):
            console.note(str(note))
        params = start_params(start, phases[0].spec)
        if changes := differences(plain(start.spec), plain(phases[-1].spec)):
            console.note(
                f"warning: the trained policy will have the inputs and the rate of the recipe "
                f"{config.recipe}, which are not those of {config.init_from} (there): "
                + first_changes(changes)
            )
    if config.delta is not None:
        try:
            stored = load_delta(config.delta)
        except ValueError as error:
            raise ValueError(f"--delta needs the --out of suite delta: {error}") from error
        for phase in phase_configs(resolved):
            dynamics = phase.quadrotor or phase.physics
            check_corrects(stored.config.get("fit", {}), dynamics, phase.spec.rate_hz, config.delta)
        delta = jax.tree.map(jax.numpy.asarray, stored.arrays)
    mirror = tensorboard(config.out) if config.tensorboard and not member.number else None
    outcome = train(resolved, config.out, console, params, delta, mirror=mirror)
    if member.number:
        return {
            "process": member.number,
            "processes": member.processes,
            "iterations": outcome.iterations,
        }
    last = outcome.last
    console.say(
        f"{counted(outcome.iterations, 'iteration')}; at the end {last['gates']:.2f} gates a "
        f"rollout, {last['collided']:.0%} collided, {last['speed']:.1f} m/s"
    )
    console.say(f"policy: {outcome.policy}")
    given = {"--vehicle": config.vehicle, "--sensors": config.sensors}
    options = [word for item in given.items() if item[1] is not None for word in item]
    line = command_line("suite", "eval", "--policy", outcome.policy, "--difficulty", 0, *options)
    console.say(f"next: {line}")
    return plain(outcome)
