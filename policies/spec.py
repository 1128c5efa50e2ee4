"""The specification of a policy: its rate, camera, observation, and the scaling of its action.

The observation is that of Su et al. 2026, Eq. 1: a state of 12 numbers, and a depth image. A policy
may add the gate after the next one, the flight direction of either gate, and the wanted speed. This
file also defines the exceptions that loading and running policies raise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, NamedTuple

import numpy as np

from tracks.common.names import unknown_name
from tracks.geometry.camera import Camera
from tracks.input.ranges import Range, check_ranges, check_type, shown

STATE_SIZE = 12
"""Number of numbers in the state of Su et al. 2026: velocity in body axes (3), third row of the
attitude matrix (3), gate in body axes (3), last action (3). Another kind of action has another size
of the last part."""
EXTRAS = {"second_gate": 3, "gate_axis": 3, "second_axis": 3, "speed_input": 1}
"""Optional parts of the state: key of a spec -> size, in this order."""
ACTION_SIZE = 3
"""Number of components of an action of kind `acceleration`."""
ACTIONS = {
    "acceleration": ("x", "y", "z"),
    "ctbr": ("thrust", "roll_rate", "pitch_rate", "yaw_rate"),
    "motors": ("rotor_1", "rotor_2", "rotor_3", "rotor_4"),
}
"""Kind of action -> names of its components; `ActionSpec.kind` explains the kinds."""

CHANNEL_BLOCK = 32
"""The channels of the second and third convolution are multiples of this, so that the C export can
store their weights in blocks."""
WIDTH_MOST = 4096
"""Largest width of the suite's network."""
HIDDEN_MOST = 2**16
"""Largest number of numbers in the memory of one row."""
RAYS_MOST = 640 * 480
"""Largest number of rays of an image: the number of pixels of usual depth cameras. 64 images of
this size, with all intermediate arrays, fit into 2 GB."""


@dataclass(frozen=True)
class DepthEncoding:
    """Conversion of depth to the policy's image: scale / clip(depth, near, far) - offset."""

    scale: Annotated[float, Range(1e-6, 1e6)] = 3.0
    """Numerator of the encoding, scale / depth - offset [m]."""
    near: Annotated[float, Range(1e-3, 100.0)] = 0.3
    """Smallest depth [m]; smaller depths are set to it."""
    offset: Annotated[float, Range(-1e6, 1e6)] = 0.6
    """Number that is subtracted in the encoding, so that distant pixels are near zero."""
    channel_axis: bool = False
    """Whether images have the shape (1, height, width), instead of (height, width)."""
    uint8: bool = False
    """Whether pixels are whole numbers, 0 at the camera's range to 255 at `near` and nearer."""

    def bounds(self, range_m: float) -> tuple[float, float]:
        """Return the smallest and largest pixel before `uint8`, for a camera's range [m]."""
        far = max(range_m, self.near)
        return self.scale / far - self.offset, self.scale / self.near - self.offset


@dataclass(frozen=True)
class ActionSpec:
    """A policy's output: its kind, and its conversion to SI units (output * scale + offset)."""

    kind: str = "acceleration"
    """acceleration: wanted net acceleration, body axes [m/s^2]; ctbr: collective thrust per mass
    [m/s^2] and body rates [rad/s]; motors: four rotors' shares, 0 to 1, of `motors`."""
    scale: Annotated[tuple[float, ...], Range(-1e6, 1e6)] = (1.0,)
    """Factor from output to SI units: one number for all, or one for each."""
    offset: Annotated[tuple[float, ...], Range(-1e6, 1e6)] = (0.0,)
    """SI value of an output of zero: one number for all, or one for each."""
    motors: str = "thrust"
    """For kind motors: an output of 1 is the largest `thrust` or the largest `speed` of a rotor."""
    clip: Annotated[float, Range(0.0, 1e6)] = 0.0
    """Outputs are clipped to plus and minus this before scaling; 0: no clipping."""

    @property
    def size(self) -> int:
        """Number of components of an action."""
        return len(ACTIONS[self.kind])

    @property
    def is_plain(self) -> bool:
        """Whether outputs are in SI units already."""
        return set(self.scale) == {1.0} and set(self.offset) == {0.0} and not self.clip

    def to_si(self, output: Any) -> Any:
        """Return outputs (..., size) in SI units; outputs in SI units are returned unchanged."""
        if self.is_plain:
            return output
        output = np.clip(output, -self.clip, self.clip) if self.clip else output
        return np.asarray(output, float) * np.asarray(self.scale) + np.asarray(self.offset)


@dataclass(frozen=True)
class PolicySpec:
    """Settings that trainer and judge share for a policy; stored in its checkpoint."""

    rate_hz: Annotated[float, Range(1.0, 500.0)] = 30.0
    """Actions per second [Hz]."""
    camera: Camera = field(default_factory=Camera)
    """Camera that takes the images; depths are clipped to its range."""
    depth: DepthEncoding = field(default_factory=DepthEncoding)
    """Conversion of depth to the image input."""
    hidden_size: Annotated[int, Range(1, WIDTH_MOST)] = 192
    """Width of the embeddings and of the recurrent state."""
    channels: Annotated[tuple[int, int, int], Range(2, 1024)] = (32, 64, 128)
    """Output channels of the three convolutions: an even number, then multiples of 32 twice."""
    second_gate: bool = False
    """Whether the state contains the centre of the gate after the next one, body axes."""
    gate_axis: bool = False
    """Whether the state contains the next gate's flight direction, body axes."""
    second_axis: bool = False
    """Whether the state contains the flight direction of the gate after the next one, body axes."""
    speed_input: bool = False
    """Whether the state contains the wanted speed, 0 (careful) to 1 (race)."""
    speed: Annotated[float, Range(0.0, 1.0)] = 1.0
    """Default of the wanted speed, 0 (careful) to 1 (race)."""
    action: ActionSpec = field(default_factory=ActionSpec)
    """The policy's output."""

    @property
    def state_size(self) -> int:
        """Number of numbers in the state observation."""
        return self.base_size + sum(count * getattr(self, key) for key, count in EXTRAS.items())

    @property
    def base_size(self) -> int:
        """Number of numbers in the state observation without the extras."""
        return STATE_SIZE - ACTION_SIZE + self.action.size

    @property
    def image_shape(self) -> tuple[int, ...]:
        """Shape of one image input."""
        shape = (self.camera.height, self.camera.width)
        return (1, *shape) if self.depth.channel_axis else shape


def check_spec(spec: PolicySpec, where: str = "spec.") -> None:
    """Refuse an impossible spec; `where` is the prefix of keys in messages.

    Raises:
        ValueError: naming the key, its value and what is allowed.
    """
    for key, kind in (("camera", Camera), ("depth", DepthEncoding), ("action", ActionSpec)):
        check_type(f"{where}{key}", getattr(spec, key), (kind,), f"an object {kind.__name__}")
    for key in ("scale", "offset"):
        numbers = getattr(spec.action, key)
        allowed = "a tuple of numbers, such as (20.0,)"
        check_type(f"{where}action.{key}", numbers, (tuple,), allowed)
    for key in EXTRAS:
        check_type(f"{where}{key}", getattr(spec, key), (bool,), "True or False")
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
        error = unknown_name("kind of action", action.kind, ACTIONS)
        raise ValueError(f"{where}action.kind: {error}")
    if action.motors not in ("thrust", "speed"):
        error = unknown_name("share of a motor", action.motors, ("thrust", "speed"))
        raise ValueError(f"{where}action.motors: {error}")
    for key in ("scale", "offset"):
        numbers = getattr(action, key)
        if len(numbers) not in (1, action.size):
            raise ValueError(
                f"{where}action.{key} is {list(numbers)}, allowed are 1 or {action.size} "
                f"numbers for {action.kind}"
            )


def check_network(spec: PolicySpec) -> None:
    """Refuse a spec that the suite's network does not support.

    Raises:
        ValueError: naming the key, its value and what is allowed.
    """
    keys = ("depth.channel_axis", "depth.uint8", "action.scale", "action.offset", "action.clip")
    for part, key in (each.split(".") for each in keys):
        value, plain = (getattr(getattr(each, part), key) for each in (spec, PolicySpec()))
        if set(np.ravel(value)) != set(np.ravel(plain)):
            raise ValueError(
                f"spec.{part}.{key} is {shown(value)}, allowed for the suite's network is "
                f"{shown(plain)}; other values are for other policies"
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
                f"spec.camera.{side} is {pixels}, allowed for the suite's network are multiples of "
                "4, from 20"
            )


class Note(NamedTuple):
    """A probable fault of a policy's interface, or an assumption about it."""

    fault: str
    """Name of the fault."""
    evidence: str
    """A sentence with the evidence: the file or the figures."""
    fix: str
    """The next step for the user."""

    def __str__(self) -> str:
        return f"{self.evidence}; {self.fix}"


class PolicyError(ValueError):
    """A policy or checkpoint is refused; the message names it, the fault and the next step."""


class NeedsTrust(PolicyError):
    """A file is refused because loading it can run its author's code, and `trust` is false."""


class NoAnswer(PolicyError):
    """A loaded policy gave no output: it failed, or exceeded the time limit."""
