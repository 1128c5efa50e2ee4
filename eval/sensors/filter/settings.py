"""What an estimator in the loop is run with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from eval.sensors.filter.kalman import ImuNoise


class FilterSettings(NamedTuple):
    """Of the filter and of the gate detections that it is given."""

    corner_sigma: float
    """Noise of a corner in the image, of each tangent, over the camera's width [pixels]."""
    width: float
    """Pixels across the camera's field of view."""
    frame_hz: float
    dropout: float
    """Share of the frames in which no gate is found [1]."""
    dropout_s: float
    """How long that lasts on average [s]."""
    delay_s: float
    """From a frame to the filter [s]."""
    range_m: float
    """Corners further away are not found [m]."""
    start_sigma: np.ndarray
    """(15,) of the error at the start, in the order of the filter's."""
    imu: ImuNoise
    """The IMU's errors as assumed by the filter."""
