"""A row of a flight over the link: what was known and done at one state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from suite.judging.link.messages import State


class Row(NamedTuple):
    """What the companion knew and did at one state."""

    state: State
    thrust: float
    """Wanted collective thrust per mass [m/s^2]."""
    rate_b: np.ndarray
    """(3,) wanted body rates [rad/s]."""
    action_b: np.ndarray
    """(3,) the policy's action in use [m/s^2]."""
    decided: bool
    """Whether the policy decided on this state."""
    gate: int
    """Number of the next gate."""
    answered_s: float
    """From the state's arrival to its set point [s]."""
    state_age_s: float
    """From the state's stamp to its set point, where both ends have one clock [s]."""
    image_age_s: float
    """From the image's arrival to the decision [s]."""
