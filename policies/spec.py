"""What a policy expects of the world: its rate, its camera and how its inputs are scaled.

The observation is the paper's (Su et al. 2026, Eq. 1), 12 numbers and a depth image, unless a
policy asks for the gate after the next one, for the flight direction of either or for how fast it
is to fly as well. The errors of policies are here, too: a person's mistake, or a model's failure.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np

from tracks.common.names import unknown_name
from tracks.geometry.camera import Camera
from tracks.input.ranges import Range, check_ranges

STATE_SIZE = 12
"""Numbers in the paper's state: v_b (3), third row of R (3), gate in body axes (3), u (3). With
another kind of action, as many more as it has than three."""
EXTRAS = {"second_gate": 3, "gate_axis": 3, "second_axis": 3, "speed_input": 1}
"""Key of a spec -> how many numbers it adds to the state, in this order."""
ACTION_SIZE = 3
"""Numbers in an action of kind `acceleration`."""
ACTIONS = {"acceleration": ACTION_SIZE, "ctbr": 4, "motors": 4}
"""Kinds of action and how many numbers each has; `ActionSpec.kind` says what they mean."""

CHANNEL_BLOCK = 32
"""Channels come in such blocks from the second convolution on, as the C export lays weights out."""
RAYS_MOST = 640 * 480
"""Rays of an image: the pixels of the usual depth cameras at full size. 64 trials' images of this
size and what they are made with fit into 2 GB."""


@dataclass(frozen=True)
class DepthEncoding:
    """Inverse depth as the network sees it: scale / clip(depth, near, far) - offset."""

    scale: Annotated[float, Range(1e-6, 1e6)] = 3.0
    """Numerator [m]."""
    near: Annotated[float, Range(1e-3, 100.0)] = 0.3
    """Depths below this read as this [m]."""
    offset: Annotated[float, Range(-1e6, 1e6)] = 0.6
    """Subtracted, so that far pixels are near zero [1]."""
    channel_axis: bool = False
    """Whether images are (1, height, width) and not (height, width)."""
    uint8: bool = False
    """Whether pixels are whole numbers, 0 at the camera's range to 255 at `near` and nearer."""

    def bounds(self, range_m: float) -> tuple[float, float]:
        """Return the least and the largest value of a pixel before `uint8` for a camera's range."""
        return self.scale / max(
            range_m, self.near
        ) - self.offset, self.scale / self.near - self.offset


@dataclass(frozen=True)
class ActionSpec:
    """What a policy's output means: kind, and the affine map from the output to SI units."""

    kind: str = "acceleration"
    """acceleration: wanted net acceleration, body axes [m/s^2]; ctbr: collective thrust per mass
    [m/s^2] and body rates [rad/s]; motors: four rotors' shares, 0 to 1, of `motors`."""
    scale: Annotated[tuple[float, ...], Range(-1e6, 1e6)] = (1.0,)
    """SI units a unit of output: one number for all, or one for each."""
    offset: Annotated[tuple[float, ...], Range(-1e6, 1e6)] = (0.0,)
    """SI value of an output of zero: one number for all, or one for each."""
    motors: str = "thrust"
    """Of kind motors: a rotor's share of its largest `thrust` or `speed`."""
    clip: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Outputs are cut off at plus and minus this before they are scaled; 0: they are not."""

    @property
    def size(self) -> int:
        """Numbers in an action."""
        return ACTIONS[self.kind]

    @property
    def is_plain(self) -> bool:
        """Whether outputs are in SI units as they are."""
        return set(self.scale) == {1.0} and set(self.offset) == {0.0} and not self.clip

    def to_si(self, output: Any) -> Any:
        """Return outputs (..., size) in SI units; plain ones are returned as they are."""
        if self.is_plain:
            return output
        output = np.clip(output, -self.clip, self.clip) if self.clip else output
        return np.asarray(output, float) * np.asarray(self.scale) + np.asarray(self.offset)


@dataclass(frozen=True)
class PolicySpec:
    """What trainer and judge must agree on for a policy to fly; stored in its checkpoint."""

    rate_hz: Annotated[float, Range(1.0, 500.0)] = 30.0
    """Actions per second [Hz]."""
    camera: Camera = field(default_factory=Camera)
    """The camera that the images come from; depths are clipped to its range."""
    depth: DepthEncoding = field(default_factory=DepthEncoding)
    """How a depth becomes an input."""
    hidden_size: Annotated[int, Range(1, 4096)] = 192
    """Width of the embeddings and of the recurrent state."""
    channels: Annotated[tuple[int, int, int], Range(2, 1024)] = (32, 64, 128)
    """Output channels of the three convolutions: an even number, then multiples of 32 twice."""
    second_gate: bool = False
    """Whether the state goes on with the centre of the gate after the next one, in body axes."""
    gate_axis: bool = False
    """Whether the state goes on with the next gate's flight direction, in body axes."""
    second_axis: bool = False
    """Whether the state goes on with that of the gate after it, in body axes."""
    speed_input: bool = False
    """Whether the state ends with how fast to fly, from 0 (careful) to 1 (a race)."""
    speed: Annotated[float, Range(0.0, 1.0)] = 1.0
    """How fast that is where nobody says otherwise [1]."""
    action: ActionSpec = field(default_factory=ActionSpec)
    """What the policy's output means."""

    @property
    def state_size(self) -> int:
        """Numbers in the state observation."""
        return self.base_size + sum(count * getattr(self, key) for key, count in EXTRAS.items())

    @property
    def base_size(self) -> int:
        """Numbers in the state observation before the extras."""
        return STATE_SIZE - ACTION_SIZE + self.action.size

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of one image as the policy is given it."""
        shape = (self.camera.height, self.camera.width)
        return (1, *shape) if self.depth.channel_axis else shape


def check_spec(spec: PolicySpec, where: str = "spec.") -> None:
    """Refuse a spec that no policy can have.

    Args:
        spec: what to check.
        where: what stands before a key in the message.

    Raises:
        ValueError: naming the key, its value and what is allowed.
    """
    check_ranges(spec, where)
    camera = spec.camera
    across, down = camera.rays * camera.width, camera.rays * camera.height
    if across * down > RAYS_MOST:
        times = f", times camera.rays {across} x {down}" if camera.rays > 1 else ""
        raise ValueError(
            f"{where}camera.width x camera.height is {camera.width} x {camera.height}{times}, "
            f"allowed is up to {RAYS_MOST} rays, as many as 640 x 480"
        )
    if spec.depth.near >= camera.range_m:
        raise ValueError(
            f"{where}depth.near is {spec.depth.near:g} m, allowed is below camera.range_m "
            f"({camera.range_m:g} m)"
        )
    action = spec.action
    if action.kind not in ACTIONS:
        raise unknown_name("kind of action", action.kind, ACTIONS)
    if action.motors not in ("thrust", "speed"):
        raise unknown_name("share of a motor", action.motors, ("thrust", "speed"))
    for key in ("scale", "offset"):
        numbers = getattr(action, key)
        if len(numbers) not in (1, action.size):
            raise ValueError(
                f"{where}action.{key} is {list(numbers)}, allowed are 1 or {action.size} "
                f"numbers for {action.kind}"
            )


def check_network(spec: PolicySpec) -> None:
    """Refuse an image that our network cannot take, and channels that it cannot have.

    Raises:
        ValueError: naming the side and its pixels, or the channels, and what is allowed.
    """
    if spec.depth.channel_axis or spec.depth.uint8 or not spec.action.is_plain:
        raise ValueError(
            "spec.depth.channel_axis, spec.depth.uint8 and spec.action.scale are for policies from "
            "elsewhere; our network has none of them"
        )
    first, *others = spec.channels
    if first % 2 or any(count % CHANNEL_BLOCK for count in others):
        raise ValueError(
            f"spec.channels is {spec.channels}, allowed are an even number and two multiples of "
            f"{CHANNEL_BLOCK}"
        )
    for side, pixels in (("width", spec.camera.width), ("height", spec.camera.height)):
        if pixels % 4 or pixels < 20:
            raise ValueError(
                f"spec.camera.{side} is {pixels}, allowed for our network are multiples of 4 from "
                "20 on"
            )


class Note(NamedTuple):
    """Something about a policy's interface that looks wrong, or has to be assumed."""

    fault: str
    """Its name."""
    evidence: str
    """What was seen, and where."""
    fix: str
    """What to do."""

    def __str__(self) -> str:
        return f"{self.evidence}; {self.fix}"


class PolicyError(ValueError):
    """A policy or checkpoint is refused; the message names it, the fault and what to do next."""


class NeedsTrust(PolicyError):
    """A file is refused since loading it can run its maker's code, and nobody said to trust it."""


class NoAnswer(PolicyError):
    """A policy that was loaded gave no answer: it failed, or did not come to an end in time."""
