"""What a policy expects of the world: its rate, its camera and how its inputs are scaled.

The observation is the paper's (Su et al. 2026, Eq. 1), 12 numbers and a depth image, unless a
policy asks for the gate after the next one or for the next gate's flight direction as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from tracks.geometry.camera import Camera

STATE_SIZE = 12
"""Numbers in the paper's state: v_b (3), third row of R (3), gate in body axes (3), u (3)."""
EXTRAS = ("second_gate", "gate_axis")
"""Keys of a spec that each add three numbers to the state, in this order."""
ACTION_SIZE = 3
"""Numbers in an action: wanted net acceleration in current body axes [m/s^2]."""


@dataclass(frozen=True)
class DepthEncoding:
    """Inverse depth as the network sees it: scale / clip(depth, near, far) - offset."""

    scale: float = 3.0
    """Numerator [m]."""
    near: float = 0.3
    """Depths below this read as this [m]."""
    offset: float = 0.6
    """Subtracted, so that far pixels are near zero [1]."""


@dataclass(frozen=True)
class PolicySpec:
    """What trainer and judge must agree on for a policy to fly; stored in its checkpoint."""

    rate_hz: float = 30.0
    """Actions per second [Hz]."""
    camera: Camera = field(default_factory=Camera)
    """The camera that the images come from; depths are clipped to its range."""
    depth: DepthEncoding = field(default_factory=DepthEncoding)
    """How a depth becomes an input."""
    hidden_size: int = 192
    """Width of the embeddings and of the recurrent state."""
    second_gate: bool = False
    """Whether the state goes on with the centre of the gate after the next one, in body axes."""
    gate_axis: bool = False
    """Whether the state ends with the next gate's flight direction, in body axes."""

    @property
    def state_size(self) -> int:
        """Numbers in the state observation."""
        return STATE_SIZE + 3 * sum(getattr(self, key) for key in EXTRAS)
