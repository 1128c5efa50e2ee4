"""All settings of a training run, as frozen dataclasses with the allowed range of each.

`TrainConfig` is the whole run; `check` refuses settings that do not fit together. A named set of
all settings is a recipe (`recipes.py`). A world is one simulated scene and drone of a batch; the
judge is the independent simulator that scores trained policies. Names such as L_clearance and
lambda_C are those of the paper, Su et al. 2026.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from eval.sensors.sensors_file import SensorSet
from eval.vehicles.vehicle import Vehicle
from policies.spec import PolicySpec, check_network, check_spec
from tracks.input.ranges import Iterations, Range, Seed, Share, check_ranges, check_type

COM_STD_MOST, TRIM_STD_MOST = 0.02, 0.2
"""Upper limits of `QuadrotorConfig.com_std_m` [m] and `trim_std` [N m]."""


@dataclass(frozen=True)
class PointMassConfig:
    """The point mass and its randomisation; the values are drawn for each world.

    The model is that of Zhang et al. 2025 (the recipe `paper` has its numbers), with wider ranges
    of lag, drag and delay.
    """

    lag_mean: Annotated[float, Range(0.1, 1000.0)] = 12.0
    """Mean rate at which the acceleration follows the command [1/s]."""
    lag_std: Annotated[float, Range(0.0, 1000.0)] = 2.0
    """Standard deviation of that rate over worlds [1/s]."""
    drag: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.1, 0.8)
    """Range of the linear drag along the body's x and y [1/s]."""
    drag_up: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.1, 0.8)
    """Range of the linear drag along the body's z [1/s]. It pushes a drone down that leans forward.
    Real rotors have more drag along z than along x and y."""
    wind_std: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds [m/s]."""
    time_step_std: Share = 0.1
    """Standard deviation of the time step over worlds, as a share of the policy's period."""
    action_delay: Annotated[tuple[float, float], Range(0.0, 2.0, ordered=True)] = (0.0, 1.5)
    """Range of the delay after which a command acts, at most 2 [policy periods]."""
    state_delay: Annotated[int, Range(0, 100)] = 0
    """Age of the state that the policy sees [policy periods]."""
    image_delay: Annotated[int, Range(0, 100)] = 0
    """Age of the image that the policy sees [policy periods]."""
    depth_noise: Annotated[float, Range(0.0, 10.0)] = 0.02
    """Standard deviation of the noise on the pixels of the encoded image, an inverse depth."""
    fov_scale: Annotated[tuple[float, float], Range(0.1, 10.0, ordered=True)] = (0.95, 1.05)
    """Range of the factor on the tangents of the half field of view, drawn in each iteration."""


@dataclass(frozen=True)
class QuadrotorConfig:
    """The differentiable quadrotor of a vehicle file and its randomisation, drawn for each world.

    Delays, noise and field of view of the observation are set in `PointMassConfig`.
    """

    vehicle: Vehicle
    """The simulation's vehicle with its effects."""
    attitude_hz: Annotated[float, Range(1.0, 10_000.0)] = 100.0
    """Approximate rate of the attitude loop [Hz]. The loop runs a whole number of times in each
    policy period."""
    physics_hz: Annotated[float, Range(10.0, 10_000.0)] = 250.0
    """Approximate rate of the physics steps (rate loop and rigid body) [Hz]. The rate of the judge
    is the vehicle's controller.frequency."""
    mass_std: Share = 0.03
    """Standard deviation of the mass over worlds, as a share of the mass in the vehicle file."""
    lag_spread: Share = 0.3
    """Largest deviation of the rotors' time constant, as a share of that in the vehicle file."""
    lag_spread_s: Annotated[float, Range(0.0, 0.5)] = 0.0
    """Largest further deviation of the rotors' time constant [s], also for a vehicle file that has
    none. The time constant is never negative."""
    drag_spread: Annotated[float, Range(0.0, 100.0)] = 0.1
    """Largest deviation of the linear drag on each axis [1/s]. The drag is never negative."""
    delay_spread_s: Annotated[float, Range(0.0, 0.1)] = 0.01
    """Largest deviation of the delay of commands [s]. The delay is between 0 and 0.1 s, or up to
    that in the vehicle file if it is longer."""
    gain_spread: Share = 0.1
    """Largest deviation of the rate loop's gain, as a share of that in the vehicle file."""
    wind_std: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds, around that of the vehicle [m/s]."""
    thrust_spread: Share = 0.0
    """Largest deviation of the thrust, as a share of that in the vehicle file."""
    com_std_m: Annotated[float, Range(0.0, COM_STD_MOST)] = 0.0
    """Standard deviation of the centre of mass over worlds, along x and along y, around that in the
    vehicle file [m]. Deviations above twice this value are cut to it."""
    trim_std: Annotated[float, Range(0.0, TRIM_STD_MOST)] = 0.0
    """Standard deviation of a constant torque over worlds, about x and about y, around that in the
    vehicle file [N m]; about z it is a fifth. Deviations above twice this value are cut to it."""

    def __post_init__(self) -> None:
        check_type("vehicle", self.vehicle, (Vehicle,), "a Vehicle, as load_vehicle returns it")


@dataclass(frozen=True)
class SensorsConfig:
    """Sensor models between the true state and the policy, as in the judge.

    The magnitude of each model, a factor on its errors, is drawn evenly for each world: 0 is a
    perfect sensor, 1 has the values of the sensors file.
    """

    seen: SensorSet
    """The sensor models with the values of the sensors file."""
    magnitude: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.0, 1.0)
    """Range of the magnitude, a factor on the errors of a model."""
    perfect_share: Share = 0.1
    """Share of the worlds with perfect sensors: every magnitude is 0."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses of Su et al. 2026, Sec. III-C3, and the strength of the field.

    The (attractive) field u_A pulls the gradient towards the next gate. The defaults gave the best
    policy on two cores; the recipe `paper` has the weights that the paper prints.
    """

    clearance: Annotated[float, Range(0.0, 1e6)] = 3.0
    """Weight of L_clearance, which keeps the drone away from solids; it includes the paper's
    lambda_C."""
    collide: Annotated[float, Range(0.0, 1e6)] = 0.2
    """Weight of L_collide, which penalises flight towards near solids [s/m^3]. With the paper's
    lambda_C of 3 the drone stops in front of gates."""
    acceleration: Annotated[float, Range(0.0, 1e6)] = 1e-2
    """Weight lambda_a of L_a, the squared acceleration [s^4/m^2]."""
    jerk: Annotated[float, Range(0.0, 1e6)] = 1e-3
    """Weight lambda_j of L_j, the squared jerk [s^6/m^2]."""
    progress: Annotated[float, Range(0.0, 1e6)] = 1.2
    """Weight lambda_p of L_p, the speed towards the gate [s/m]."""
    speed_range: Annotated[tuple[float, float], Range(0.1, 100.0, ordered=True)] = (1.5, 7.0)
    """Commanded speeds [m/s] for speed inputs of 0 and just below 1 (`spec.speed_input`). Progress
    counts up to the commanded speed, and speed above it is penalised as much. An input of 1 means
    no limit."""
    progress_norm: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight of L_p^norm, a progress loss of an ablation in the paper, which rewards the direction
    of flight alone."""
    projection: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight lambda_proj of L_proj, a loss on the distance to the gate's axis that can replace the
    field [1/m^2]."""
    approach_m: Annotated[float, Range(0.0, 100.0)] = 0.0
    """Largest distance before a gate of the point towards which progress is measured [m]. The
    further the drone is off the gate's axis or beyond its plane, the further the point is from the
    gate, on its axis: the straight line to the centre would hit the frame. 0: the point is always
    the centre."""
    pass_first: bool = False
    """Whether the step that passes a gate measures progress towards the next gate instead of the
    passed one. With these weights policies then fly faster and less carefully."""
    projection_decay: Annotated[float, Range(0.0, 1000.0)] = 0.5
    """beta_3, decay rate of L_proj with the distance to the gate [1/m]."""
    safety_radius_m: Annotated[float, Range(0.0, 10.0)] = 0.2
    """r_q: the drone's radius with a margin, for L_clearance and L_collide [m]."""
    field_gain: Annotated[float, Range(0.0, 1e6)] = 10.0
    """Strength of the field u_A [1/m]: the gradient that it adds at the centre of a 1 m gate for a
    velocity across the gate's axis, in one step and one world, before averaging. 0: no field."""
    gradient_decay: Annotated[float, Range(0.0, 1000.0)] = 0.916
    """alpha, the decay rate of gradients back in time [1/s]: those of position and velocity, and of
    attitude and rates of quadrotors."""
    crash_depth_m: Annotated[float, Range(0.0, math.inf)] = 0.0
    """Depth in a solid beyond which a world no longer counts in the loss of a rollout [m]:
    gradients inside a solid do not help to fly."""
    tilt: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight of L_tilt, which grows from 0 at a tilt of 65 degrees to 1 at 90 degrees, where the
    judge ends a trial. If it is above 0, a world that tilts beyond 90 degrees no longer counts in
    the loss. It has a gradient for quadrotors only, since a point mass has no attitude."""


@dataclass(frozen=True)
class EpisodeConfig:
    """How the worlds of one iteration are drawn, and how long they fly."""

    batch: Annotated[int, Range(1, 10**6)] = 64
    """Worlds per iteration, over all devices; a multiple of `shards`."""
    shards: Annotated[int, Range(1, 4096)] = 2
    """Number of parts of a batch whose gradients are computed separately, on up to as many cores or
    devices, and added in order. The result has the same bits on any number of them. Smaller parts
    need more time per world: 4 parts of 16 worlds a fifth more than 2 of 32."""
    steps: Annotated[int, Range(1, 10**5)] = 90
    """Policy periods per rollout."""
    image_stride: Annotated[int, Range(1, 10**5)] = 1
    """Distance N in steps between the images from which the gradient of the image encoder is
    computed. The first one is random, and the gradient is multiplied by N. It saves time, since
    neighbouring images are similar. Must divide `steps`."""
    gates: Annotated[int, Range(1, 8)] = 8
    """Number of gates of a track: the first ones of a drawn track of eight."""
    difficulty: Annotated[tuple[float, float], Range(0.0, 1.0, ordered=True)] = (0.0, 1.0)
    """Range of the tracks' difficulty."""
    rest_share: Share = 0.3
    """Share of worlds that start at rest at the track's start; the others start between two gates,
    with a recurrent state from a random step of the last rollout."""
    stop_from: Share = 0.33
    """Share of `steps` after which worlds that start at rest no longer count in the loss, from a
    random step on. So the policy cannot count the remaining steps and take risks at the end. 1: all
    steps count."""
    start_speed: Annotated[float, Range(0.0, 100.0)] = 6.0
    """Largest speed towards the gate in worlds that start between two gates [m/s]. A smaller
    sideways speed is added."""
    missed_share: Share = 0.0
    """Of the worlds that do not start at rest, the share that start next to or above a gate's
    frame, as after missing the gate, instead of between two gates."""
    sharp_share: Share = 0.55
    """Share of tracks with one or two sharp turns."""
    density: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.0, 1.3)
    """Range of the density of obstacles, as a share of that in the families of the judge."""
    bare_share: Share = 0.2
    """Share of tracks without obstacles."""
    finish: bool = False
    """Whether a world no longer counts in the loss after its last gate. If it counts, its goal
    becomes a point 10 m behind the gate, which rewards speed more at the last gate than at the
    others."""
    height_spread: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Factor on the usual spread of the gates' heights, before they are limited to 0.8 to 2.2 m. A
    factor of 2 gives about the spread of circular and elliptic tracks."""
    race_share: Share = 0.5
    """Share of worlds in which the input of a policy with `spec.speed_input` is 1; in the others it
    is drawn from 0 to 1."""
    hairpin_share: Share = 0.0
    """Share of tracks with one or two gates that are entered nearly from the side and left
    backwards, as at the apexes of the hardest ellipses."""


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with a cosine schedule in each phase."""

    iterations: Iterations = 2000
    """Gradient steps of the whole run."""
    rate: Annotated[float, Range(0.0, 10.0, above=True)] = 2e-3
    """Peak learning rate."""
    warmup: Annotated[int, Range(0, 10**9)] = 20
    """Gradient steps of linear warm-up of each phase; the first has a learning rate of 0."""
    memory: Annotated[float, Range(0.0, 1.0, below=True)] = 0.99
    """Adam's beta_2. It is below the usual 0.999, because the first crashes have ten times
    larger gradients, which must be forgotten soon."""
    clip: Annotated[float, Range(0.0, 1e12)] = 1.0
    """Largest global norm of the gradient; a larger gradient is scaled down to it. 0: no limit."""


@dataclass(frozen=True)
class Phase:
    """A part of a training in which some settings differ from those of the phase before."""

    share: Annotated[float, Range(0.0, 1.0, above=True)] = 1.0
    """Share of the run's gradient steps."""
    set: tuple[str, ...] = ()
    """Changes at the beginning of the phase, such as "loss.progress=2.2"; later phases keep these
    values."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    spec: PolicySpec = field(default_factory=lambda: PolicySpec(rate_hz=15.0))
    """Rate, camera and encodings of the policy."""
    physics: PointMassConfig = field(default_factory=PointMassConfig)
    """The point mass and its randomisation, and delays and noise of the observation."""
    quadrotor: QuadrotorConfig | None = None
    """The quadrotor through which the policy is trained; None: the point mass of `physics`."""
    sensors: SensorsConfig | None = None
    """Sensor models between the true state and the policy; None: perfect sensors."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the loss and of the field."""
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    """How worlds are drawn, and how long they fly."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimiser and its learning-rate schedule, which starts again in every phase."""
    phases: tuple[Phase, ...] = ()
    """Phases of the run; their shares add up to 1. Empty: one phase without changes."""
    seed: Seed = 0
    """Seed of the parameters, the tracks and the randomisation."""


def check_decides_in_time(spec: PolicySpec, vehicle: Vehicle) -> None:
    """Refuse a policy that decides faster than its vehicle's controller runs.

    Raises:
        ValueError: naming both rates.
    """
    rate, frequency = spec.rate_hz, vehicle.controller.frequency
    if rate > frequency:
        raise ValueError(
            f"the policy decides at {rate:g} Hz, allowed is up to the {frequency:g} Hz of vehicle "
            f"{vehicle.name!r}'s controller.frequency"
        )


def check(config: TrainConfig) -> None:
    """Refuse settings outside their ranges, before anything is compiled or written.

    Raises:
        ValueError: naming the setting, its value and what is allowed.
    """
    check_ranges(config)
    check_spec(config.spec)
    check_network(config.spec)
    if config.spec.action.kind != "acceleration":
        raise ValueError(
            f"spec.action.kind is {config.spec.action.kind}, allowed for a training is acceleration"
        )
    if config.quadrotor is not None:
        from eval.vehicles.vehicle_check import check_vehicle

        check_vehicle(config.quadrotor.vehicle)
        check_decides_in_time(config.spec, config.quadrotor.vehicle)
    batch, shards = config.episode.batch, config.episode.shards
    if batch % shards:
        raise ValueError(
            f"episode.batch is {batch}, allowed are multiples of episode.shards ({shards}); change "
            "one of the two"
        )
    stride, steps = config.episode.image_stride, config.episode.steps
    if steps % stride:
        raise ValueError(
            f"episode.image_stride is {stride}, allowed are divisors of episode.steps ({steps})"
        )
