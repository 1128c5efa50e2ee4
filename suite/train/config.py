"""All settings of a training run, as frozen dataclasses with the allowed range of each.

`TrainConfig` is the whole run; `check` refuses settings that do not fit together. A named set of
them is a recipe (`recipes.py`). A world is one simulated scene and drone of a batch; the judge is
the independent simulator that scores trained policies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

from eval.sensors.sensors_file import SensorSet
from eval.vehicles.vehicle import Vehicle
from policies.spec import PolicySpec, check_network, check_spec
from tracks.input.ranges import Iterations, Range, Seed, Share, check_ranges

COM_STD_MOST, TRIM_STD_MOST = 0.02, 0.2
"""Upper limits of `QuadrotorConfig.com_std_m` [m] and `trim_std` [N m]."""


@dataclass(frozen=True)
class PointMassConfig:
    """The point mass and its randomisation, drawn per world.

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
    """Range of the linear drag along the body's z, which pushes a forward-leaning drone down; real
    rotors have more drag along z than along x and y [1/s]."""
    wind_std: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds [m/s]."""
    time_step_std: Share = 0.1
    """Standard deviation of a world's time step as a share of the policy's period [1]."""
    action_delay: Annotated[tuple[float, float], Range(0.0, 2.0, ordered=True)] = (0.0, 1.5)
    """Range of the delay after which a command acts [policy periods, at most 2]."""
    state_delay: Annotated[int, Range(0, 100)] = 0
    """Age of the state that the policy sees [policy periods]."""
    image_delay: Annotated[int, Range(0, 100)] = 0
    """Age of the image that the policy sees [policy periods]."""
    depth_noise: Annotated[float, Range(0.0, 10.0)] = 0.02
    """Standard deviation of the noise on the encoded inverse depth [1]."""
    fov_scale: Annotated[tuple[float, float], Range(0.1, 10.0, ordered=True)] = (0.95, 1.05)
    """Range of the factor on the tangents of the half field of view, drawn per iteration [1]."""


@dataclass(frozen=True)
class QuadrotorConfig:
    """The differentiable quadrotor around a vehicle file, with a randomisation drawn per world.

    Images and their delay, noise and field of view are set in `PointMassConfig`.
    """

    vehicle: Vehicle
    """The simulation's vehicle with its effects."""
    attitude_hz: Annotated[float, Range(1.0, 10_000.0)] = 100.0
    """Approximate rate of the attitude loop; it runs a whole number of times a policy period
    [Hz]."""
    physics_hz: Annotated[float, Range(10.0, 10_000.0)] = 250.0
    """Approximate rate of the physics steps (rate loop and rigid body); the judge steps at the
    vehicle's controller.frequency [Hz]."""
    mass_std: Share = 0.03
    """Standard deviation of the true mass over worlds, as a share of the vehicle's [1]."""
    lag_spread: Share = 0.3
    """The rotors' time constant varies by up to +- this share of the vehicle's [1]."""
    lag_spread_s: Annotated[float, Range(0.0, 0.5)] = 0.0
    """The rotors' time constant varies by up to +- this as well, but is never negative: for a
    vehicle file without one [s]."""
    drag_spread: Annotated[float, Range(0.0, 100.0)] = 0.1
    """Linear drag varies by up to +- this on each axis, but is never negative [1/s]."""
    delay_spread_s: Annotated[float, Range(0.0, 0.1)] = 0.01
    """The delay of commands varies by up to +- this, within 0 to 0.1 s or up to the vehicle's own
    delay if that is longer [s]."""
    gain_spread: Share = 0.1
    """The rate loop's gain varies by up to +- this share [1]."""
    wind_std: Annotated[tuple[float, float, float], Range(0.0, 100.0)] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds, around the vehicle's [m/s]."""
    thrust_spread: Share = 0.0
    """The true thrust varies by up to +- this share of the vehicle's [1]."""
    com_std_m: Annotated[float, Range(0.0, COM_STD_MOST)] = 0.0
    """Standard deviation of the centre of mass along x and along y, around the vehicle's,
    truncated at twice that [m]."""
    trim_std: Annotated[float, Range(0.0, TRIM_STD_MOST)] = 0.0
    """Standard deviation of a constant torque about x and about y, around the vehicle's, truncated
    at twice that; a fifth of it about z [N m]."""


@dataclass(frozen=True)
class SensorsConfig:
    """Sensor models between the true state and the policy, as in the judge.

    The magnitude of each model is drawn evenly per world: 0 is the truth, 1 the file's values.
    """

    seen: SensorSet
    """The models at magnitude 1."""
    magnitude: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.0, 1.0)
    """Range of the magnitude [1]."""
    perfect_share: Share = 0.1
    """Share of the worlds in which every magnitude is 0."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses of Su et al. 2026, Sec. III-C3, and the strength of the field.

    The defaults gave the best policy on two cores; the recipe `paper` has the printed weights.
    """

    clearance: Annotated[float, Range(0.0, 1e6)] = 3.0
    """Weight of L_clearance, which keeps the drone away from solids; it includes the paper's
    lambda_C [1]."""
    collide: Annotated[float, Range(0.0, 1e6)] = 0.2
    """Weight of L_collide, which penalises contact with solids. The paper's lambda_C of 3 stops the
    drone in front of gates [1]."""
    acceleration: Annotated[float, Range(0.0, 1e6)] = 1e-2
    """Weight lambda_a of L_a, the squared acceleration [s^4/m^2]."""
    jerk: Annotated[float, Range(0.0, 1e6)] = 1e-3
    """Weight lambda_j of L_j, the squared jerk [s^6/m^2]."""
    progress: Annotated[float, Range(0.0, 1e6)] = 1.2
    """Weight lambda_p of L_p, the speed towards the gate [s/m]."""
    speed_range: Annotated[tuple[float, float], Range(0.1, 100.0, ordered=True)] = (1.5, 7.0)
    """Commanded speed at an input of 0 and just below 1, for a policy with `spec.speed_input`.
    Progress counts up to the commanded speed, and the excess costs as much; at 1 there is no limit
    [m/s]."""
    progress_norm: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight of L_p^norm, a progress loss of the paper's ablation that rewards the direction of
    flight alone [1]."""
    projection: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight lambda_proj of L_proj, a scalar loss that replaces the field [1/m^2]."""
    approach_m: Annotated[float, Range(0.0, 100.0)] = 0.0
    """If the drone is off a gate's axis or beyond its plane, progress is measured towards a point
    on the axis before the gate, as far before it as the drone is off, up to this distance. The
    straight line to the centre would hit the frame. 0: always towards the centre [m]."""
    pass_first: bool = False
    """Whether the step that passes a gate measures progress towards the next gate instead of the
    passed one. Policies then fly faster and less carefully at these weights."""
    projection_decay: Annotated[float, Range(0.0, 1000.0)] = 0.5
    """beta_3: decay of L_proj with the distance to the gate [1/m]."""
    safety_radius_m: Annotated[float, Range(0.0, 10.0)] = 0.2
    """r_q: the drone's radius with a margin, for L_clearance and L_collide [m]."""
    field_gain: Annotated[float, Range(0.0, 1e6)] = 10.0
    """Gradient per step, of the loss before averaging over time and batch, that u_A adds at the
    centre of a 1 m gate to a velocity across it [1/m]; 0 turns the field off."""
    gradient_decay: Annotated[float, Range(0.0, 1000.0)] = 0.916
    """alpha, the decay rate of the gradients of position and velocity, back in time [1/s]."""
    crash_depth_m: Annotated[float, Range(0.0, math.inf)] = 0.0
    """A world deeper than this in a solid no longer counts in the loss of this rollout: gradients
    inside a solid do not help to fly [m]."""
    tilt: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Weight of L_tilt, which grows from 0 at a tilt of 65 degrees to 1 at 90 degrees, where the
    judge ends a trial. Above 0 a world beyond 90 degrees no longer counts. It has a gradient for
    quadrotors only; a point mass has no attitude [1]."""


@dataclass(frozen=True)
class EpisodeConfig:
    """How the worlds of one iteration are drawn, and how long they fly."""

    batch: Annotated[int, Range(1, 10**6)] = 64
    """Worlds per iteration, over all devices; a multiple of `shards`."""
    shards: Annotated[int, Range(1, 4096)] = 2
    """Parts of a batch whose gradients are computed separately and added in order, by up to as many
    cores or devices; the result has the same bits on any number of them. Smaller parts cost more
    per world: 4 parts of 16 worlds a fifth more than 2 of 32."""
    steps: Annotated[int, Range(1, 10**5)] = 90
    """Policy periods per rollout."""
    image_stride: Annotated[int, Range(1, 10**5)] = 1
    """The encoder's gradient is taken from every N-th image of a rollout, from a random first one
    on, and weighted by N: neighbouring images are similar. Must divide `steps`."""
    gates: Annotated[int, Range(1, 8)] = 8
    """Number of gates of a track: its first ones, of eight."""
    difficulty: Annotated[tuple[float, float], Range(0.0, 1.0, ordered=True)] = (0.0, 1.0)
    """Range of the tracks' difficulty."""
    rest_share: Share = 0.3
    """Share of worlds that start at rest at the track's start; the others start between two gates,
    with a recurrent state from a random step of the last rollout."""
    stop_from: Share = 0.33
    """Worlds that start at rest no longer count in the loss from a random step after this share of
    `steps`, so that the policy cannot count the remaining steps and take risks at the end; 1: all
    count."""
    start_speed: Annotated[float, Range(0.0, 100.0)] = 6.0
    """Largest speed towards the gate of a world that starts between two gates; a sideways speed is
    added [m/s]."""
    missed_share: Share = 0.0
    """Share of the worlds without a start at rest that start next to or above a gate's frame, as
    after missing the gate, instead of between two gates."""
    sharp_share: Share = 0.55
    """Share of tracks with one or two sharp turns."""
    density: Annotated[tuple[float, float], Range(0.0, 100.0, ordered=True)] = (0.0, 1.3)
    """Range of the obstacles' density as a share of the judged families'."""
    bare_share: Share = 0.2
    """Share of tracks without obstacles."""
    finish: bool = False
    """Whether a world no longer counts in the loss after its last gate. If not, its goal becomes a
    point 10 m beyond, which makes speed worth more at the last gate than at the others."""
    height_spread: Annotated[float, Range(0.0, 100.0)] = 1.0
    """Factor on the usual spread of the gates' heights, before they are limited to 0.8 to 2.2 m; 2
    gives about the spread of circles and ellipses [1]."""
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
    rate: Annotated[float, Range(0.0, 10.0)] = 2e-3
    """Peak learning rate."""
    warmup: Annotated[int, Range(0, 10**9)] = 20
    """Gradient steps of linear warm-up of each phase; the first has a learning rate of 0."""
    memory: Annotated[float, Range(0.0, 1.0, below=True)] = 0.99
    """Adam's beta_2. It is below the usual 0.999, because the first crashes have ten times
    larger gradients, which must be forgotten soon."""
    clip: Annotated[float, Range(0.0, 1e12)] = 1.0
    """A gradient of a larger global norm is scaled down to it; 0: never."""


@dataclass(frozen=True)
class Phase:
    """A part of a training in which some settings differ from those before."""

    share: Annotated[float, Range(0.0, 1.0, above=True)] = 1.0
    """Share of the run's gradient steps [1]."""
    set: tuple[str, ...] = ()
    """Settings that change at the beginning of the phase, such as "loss.progress=2.2"; they keep
    their values in later phases."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    spec: PolicySpec = field(default_factory=lambda: PolicySpec(rate_hz=15.0))
    """Rate, camera and encodings of the policy."""
    physics: PointMassConfig = field(default_factory=PointMassConfig)
    """Dynamics and their randomisation."""
    quadrotor: QuadrotorConfig | None = None
    """Train through this quadrotor; None: through the point mass of `physics`."""
    sensors: SensorsConfig | None = None
    """Sensor models between the true state and the policy; None: perfect sensors."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the loss and of the field."""
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    """Worlds and horizon."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimiser and its schedule, which begins again in every phase."""
    phases: tuple[Phase, ...] = ()
    """Phases with changed settings; their shares add up to 1. Empty: one phase without changes."""
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
