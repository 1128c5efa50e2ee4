"""Depth cameras: what they show of depths, by hand and where nothing is within the range."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from eval import sensors
from eval.sensors import SENSORS, view_models
from eval.sensors.sensors_file import sensor_set
from tests.support.sensor_views import CAMERA, DT_S, draws_of, seen_through, view

STEREO = {"focal": 400.0, "baseline": 0.05}
RANGES, EDGES = np.array([1.0, 2.0, 4.0, 8.0] * 2), np.array([6.0, 6, 6, 3, 6, 6, 2, 2])
STEPS = np.array([6.0, 6.0, 3.0, 3.0, 6.0, 6.0, 10.0, 10.0])
WRAP = 299_792_458.0 / 75e6 * (STEPS == 6.0)
"""Half a wavelength of 37.5 MHz, nearly 4 m."""
DEPTHS = [
    ("stereo", STEREO | {"noise": 0.1, "offset": 0.2}, {"grain": 2.0}, RANGES,
     20.0 / (20.0 / RANGES + 0.4)),
    # Disparities of 20, 10, 5 and 2.5 become 21, 9, 6 and 3, and what is too near is a hole.
    ("stereo", STEREO | {"step": 3.0, "near": 1.5}, {}, RANGES, [10.0, 20 / 9, 20 / 6, 20 / 3] * 2),
    ("stereo", STEREO | {"noise": 0.1, "least": 4.0}, {}, RANGES, [1.0, 2.0, 4.0, 10.0] * 2),
    ("stereo", STEREO | {"noise": 0.1}, {"grain": 1.0}, STEPS + 4.0 * (STEPS == 6.0),
     [10.0, 10, 20 / (20 / 3 + 0.1), 20 / (20 / 3 + 0.1), 10, 10, 10, 10]),
    ("stereo", STEREO | {"edge_holes": 1.0}, {"chance": 0.5}, EDGES, [6, 6, 10, 3, 10, 10, 2, 2]),
    ("stereo", STEREO | {"thin_holes": 1.0}, {"chance": 0.5}, EDGES, [6, 6, 6, 6, 6, 6, 2, 2]),
    ("stereo", STEREO | {"smear": 1.0}, {"chance": 0.5}, EDGES, [6, 6, 3, 3, 3, 2, 2, 2]),
    ("tof", {"noise": 0.01, "bias": 0.02}, {"grain": 1.0}, STEPS, np.fmin(1.03 * STEPS, 10.0)),
    ("tof", {"mixing": 1.0}, {"chance": 0.25}, STEPS, [6, 5.25, 3, 3, 5.25, 6, 9, 10]),
    ("tof", {"wrapped": 1.0, "modulation": 37.5e6}, {"chance": 0.5}, STEPS, STEPS - WRAP),
]  # fmt: skip
"""Model, its values, draws, true depths [m] of a row of pixels and what is shown of them."""


@pytest.mark.parametrize(("name", "values", "draws", "depth", "wanted"), DEPTHS)
def test_depths_by_hand(name, values, draws, depth, wanted):
    trial = {"normal": {"stereo": 1.0, "tof": -1.0}[name]}
    (shown,) = seen_through(name, values, [view(depth=depth)], trial, **draws)
    assert shown.depth_m[0, 3] == pytest.approx(np.array(wanted, float))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", ["stereo", "tof"])
def test_with_nothing_in_range_a_turning_camera_shows_the_range(name, dtype):
    motion = {"image_motion": {"exposure": 0.01, "readout": 0.02}}
    models = view_models(sensor_set(motion | {name: {"noise": 0.1}}).models)
    models = {kind: type(v)(*(x.astype(dtype) for x in v)) for kind, v in models.items()}
    rots = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.01, 0.03, 0.02]]).as_matrix().astype(dtype)
    empty = np.full((1, 6, 8), CAMERA.range_m, dtype)
    before, then = (view(rot=rot[None])._replace(depth_m=empty) for rot in rots)
    trial = {kind: draws_of(SENSORS[kind].trial) for kind in models}
    memory = sensors.start(models, before, trial, DT_S, CAMERA)
    draws = {kind: draws_of(SENSORS[kind].observation, grain=[-1.0, 1.0] * 4) for kind in models}
    seen, _ = sensors.sense(models, memory, then, draws, dtype(DT_S), CAMERA)
    np.testing.assert_allclose(seen.depth_m, CAMERA.range_m, rtol=1e-6)
