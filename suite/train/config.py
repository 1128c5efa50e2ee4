"""Every setting of a training run, as frozen dataclasses the command line reads; their limits."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any

from eval.vehicles.vehicle import Vehicle
from policies.spec import PolicySpec


@dataclass(frozen=True)
class PointMassConfig:
    """The simulator's dynamics and their randomisation, drawn per world.

    The model is that of Zhang et al. 2025 (the preset `paper` has its numbers), with lag, drag and
    delay drawn from wider ranges.
    """

    lag_mean: float = 12.0
    """Mean rate at which the acceleration follows the command [1/s]."""
    lag_std: float = 2.0
    """Its standard deviation over worlds [1/s]."""
    drag: tuple[float, float] = (0.1, 0.8)
    """Range of the linear drag along the body's x and y [1/s]."""
    drag_up: tuple[float, float] = (0.1, 0.8)
    """Range of the linear drag along the body's z, which pushes a drone that leans forward down;
    real rotors have more of it than of the other two [1/s]."""
    wind_std: tuple[float, float, float] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds [m/s]."""
    time_step_std: float = 0.1
    """Standard deviation of a world's time step as a share of the policy's period [1]."""
    action_delay: tuple[float, float] = (0.0, 1.5)
    """Range of the delay after which a command acts [policy periods, at most 2]."""
    state_delay: int = 0
    """Age of the state that the policy sees [policy periods]."""
    image_delay: int = 0
    """Age of the image that the policy sees [policy periods]."""
    depth_noise: float = 0.02
    """Standard deviation of the noise on the encoded inverse depth [1]."""
    fov_scale: tuple[float, float] = (0.95, 1.05)
    """Range by which the images' half widths, as tangents, are scaled: the field of view, drawn per
    iteration [1]."""
    heading_rate: float = 6.0
    """Rate at which the heading follows the direction to the gate [1/s]."""


@dataclass(frozen=True)
class QuadrotorConfig:
    """The differentiable quadrotor around a vehicle file; what varies is drawn per world.

    Images and their delay, noise and field of view are those of `PointMassConfig`.
    """

    vehicle: Vehicle
    """The simulation's vehicle with its effects."""
    attitude_hz: float = 100.0
    """About how often the attitude loop runs: a whole number of times a policy period [Hz]."""
    physics_hz: float = 250.0
    """About how often rate loop and rigid body are stepped; the judge steps at the vehicle's
    controller.frequency [Hz]."""
    mass_std: float = 0.03
    """Standard deviation of the true mass over worlds, as a share of the vehicle's [1]."""
    lag_spread: float = 0.3
    """The rotors' time constant varies by up to this share of the vehicle's either way [1]."""
    drag_spread: float = 0.1
    """Linear drag varies by up to this on each axis either way, and is never negative [1/s]."""
    delay_spread_s: float = 0.01
    """The delay of commands varies by up to this either way, and is never negative [s]."""
    gain_spread: float = 0.1
    """The rate loop's gain varies by up to this share either way [1]."""
    wind_std: tuple[float, float, float] = (1.0, 1.0, 0.2)
    """Standard deviation of the constant wind over worlds, around the vehicle's [m/s]."""


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses of Su et al. 2026, Sec. III-C3, and the strength of the field.

    The defaults race best on two cores; the preset `paper` has the printed ones.
    """

    clearance: float = 3.0
    """Weight of L_clearance, with the paper's lambda_C [1]."""
    collide: float = 0.2
    """Weight of L_collide; the paper's lambda_C of 3 stops the drone in front of gates [1]."""
    acceleration: float = 1e-2
    """lambda_a [s^4/m^2]."""
    jerk: float = 1e-3
    """lambda_j [s^6/m^2]."""
    progress: float = 1.2
    """lambda_p of L_p [s/m]."""
    progress_norm: float = 0.0
    """Weight of L_p^norm, the ablation's direction-only progress [1]."""
    projection: float = 0.0
    """lambda_proj of L_proj, the scalar substitute for the field [1/m^2]."""
    approach_m: float = 0.0
    """Where the drone is off a gate's axis or beyond its plane, progress is measured towards a
    point on the axis before the gate, by as much as it is off, at most this far: straight to the
    centre the frame is in the way, and the drone hovers above it; 0: always the centre [m]."""
    pass_first: bool = False
    """Whether the step that passes a gate measures progress towards the next one already, and not
    backwards to the one that was passed: faster, and less careful at these weights."""
    projection_decay: float = 0.5
    """beta_3 of L_proj [1/m]."""
    barrier_height: float = 2.0
    """beta_1 of L_clearance [1]."""
    barrier_slope: float = -32.0
    """beta_2 of L_clearance [1/m]."""
    safety_radius_m: float = 0.2
    """r_q, the drone's radius with its margin [m]."""
    field_gain: float = 10.0
    """Gradient per step, of the loss before averaging over time and batch, that u_A adds at the
    centre of a 1 m gate to a velocity across it [1/m]; 0 turns the field off."""
    field_square: bool = False
    """Whether every gate pulls as the square around its opening would, whatever its shape."""
    field_decay: float = 0.3
    """lambda_A, how slowly u_A falls with distance [1]."""
    gradient_decay: float = 0.916
    """alpha, the rate at which gradients of position and velocity fade back in time [1/s]."""
    crash_depth_m: float = 0.0
    """A world that gets deeper than this into a solid leaves the loss for the rest of the rollout:
    from there on its gradients say nothing about flying [m]."""
    path_samples: int = 4
    """Points of every step's path at which the nearest obstacle is looked up."""


@dataclass(frozen=True)
class EpisodeConfig:
    """The worlds of one iteration."""

    batch: int = 64
    """Worlds per iteration, over all devices."""
    steps: int = 90
    """Policy periods per rollout."""
    image_stride: int = 1
    """The encoder's gradient is taken from one in so many of a rollout's images, with a random
    first one, and weighted accordingly: neighbours look alike. Must divide `steps`."""
    gates: int = 8
    """Gates of a track, the first so many of those that it is made with, at most 8."""
    difficulty: tuple[float, float] = (0.0, 1.0)
    """Range of the tracks' difficulty."""
    easy_until: float = 0.0
    """Share of training during which the range of difficulty grows from its lower end."""
    rest_share: float = 0.3
    """Share of worlds that start at rest at the track's start; the others start on the way, with a
    recurrent state from a random step of the last rollout."""
    stop_from: float = 0.33
    """Worlds that start at rest leave the loss at a random step from this share of `steps` on, so
    that the policy cannot count the steps left and go for broke at the end; 1: none leaves."""
    start_speed: float = 6.0
    """Largest speed towards the gate of a world that starts on the way; sideways some is added
    [m/s]."""
    missed_share: float = 0.0
    """Share of the worlds that start on the way which start beside or above their gate's frame, as
    one does that has missed it."""
    sharp_share: float = 0.55
    """Share of tracks with one or two sharp turns."""
    density: tuple[float, float] = (0.0, 1.3)
    """Range of the obstacles' density as a share of the judged families'."""
    bare_share: float = 0.2
    """Share of tracks without obstacles."""
    finish: bool = False
    """Whether a world leaves the loss as it passes its last gate. If not, it is to fly on to a
    point 10 m beyond, so that speed is worth more at the last gate than at the others."""
    height_spread: float = 1.0
    """How far gates' heights lie apart before they are held to 0.8 to 2.2 m, as a share of what is
    usual for a difficulty: with 2 they lie about as far apart as those of circles and ellipses."""
    gate_corners: int = 4
    """Corners of the gates' openings: 4 for squares, more for rounder gates of the same width."""
    hairpin_share: float = 0.0
    """Share of tracks with one or two gates that are met nearly from the side and left backwards,
    as at the apexes of the hardest ellipses."""


@dataclass(frozen=True)
class OptimizerConfig:
    """AdamW with a cosine schedule."""

    iterations: int = 2000
    """Gradient steps."""
    rate: float = 2e-3
    """Peak learning rate."""
    rate_end: float = 1e-5
    """Learning rate at the end."""
    warmup: int = 20
    """Iterations of linear warm-up."""
    weight_decay: float = 1e-2
    """AdamW's decoupled weight decay."""
    memory: float = 0.99
    """Adam's beta_2: short, because the first crashes' gradients are ten times all later ones."""
    clip: float = 1.0
    """Largest global norm of a gradient; 0 does not clip."""


@dataclass(frozen=True)
class TrainConfig:
    """A training run."""

    spec: PolicySpec = field(default_factory=lambda: PolicySpec(rate_hz=15.0))
    """Rate, camera and encodings of the policy."""
    physics: PointMassConfig = field(default_factory=PointMassConfig)
    """Dynamics and their randomisation."""
    quadrotor: QuadrotorConfig | None = None
    """Train through this quadrotor; None: through the point mass of `physics`."""
    loss: LossConfig = field(default_factory=LossConfig)
    """Weights of the loss and of the field."""
    episode: EpisodeConfig = field(default_factory=EpisodeConfig)
    """Worlds and horizon."""
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    """Optimiser and its schedule."""
    seed: int = 0
    """Seed of the parameters, the tracks and the randomisation."""
    devices: int = 0
    """JAX devices to share the batch; 0 takes all that divide it."""


SHARE = (0.0, 1.0)
LIMITS = {
    "seed": (0, 2**32 - 1),
    "optimizer.iterations": (1, math.inf),
    "optimizer.warmup": (0, math.inf),
    "episode.batch": (1, math.inf),
    "episode.steps": (1, math.inf),
    "episode.gates": (1, 8),
    "episode.gate_corners": (3, math.inf),
    "episode.difficulty": SHARE,
    "episode.easy_until": SHARE,
    "episode.rest_share": SHARE,
    "episode.stop_from": SHARE,
    "episode.missed_share": SHARE,
    "episode.sharp_share": SHARE,
    "episode.bare_share": SHARE,
    "episode.hairpin_share": SHARE,
    "episode.density": (0.0, math.inf),
    "episode.height_spread": (0.0, math.inf),
    "episode.start_speed": (0.0, math.inf),
    "loss.path_samples": (1, math.inf),
    "physics.action_delay": (0.0, 2.0),
    "physics.state_delay": (0, math.inf),
    "physics.image_delay": (0, math.inf),
}
"""The least and the most that is allowed, both included unless infinite."""


def check(config: TrainConfig) -> None:
    """Refuse settings outside their limits, before anything is compiled or written.

    Raises:
        ValueError: naming the setting, its value and what is allowed.
    """
    for path, (low, high) in LIMITS.items():
        value: Any = functools.reduce(getattr, path.split("."), config)
        ends = value if isinstance(value, tuple) else (value,)
        allowed = f"{low:g} and more" if math.isinf(high) else f"{low:g} to {high:.10g}"
        if not all(low <= end <= high and math.isfinite(end) for end in ends):
            raise ValueError(f"{path} is {value}, allowed are {allowed}")
        if list(ends) != sorted(ends):
            raise ValueError(f"{path} is {value}; give the lower end of the range first")
    stride, steps = config.episode.image_stride, config.episode.steps
    if stride < 1 or steps % stride:
        raise ValueError(
            f"episode.image_stride is {stride}, allowed are divisors of episode.steps ({steps})"
        )
