"""Settings, actions and seeds that the environments refuse or accept."""

import os
import warnings
from dataclasses import replace

os.environ.setdefault("MUJOCO_GL", "disable")

import numpy as np
import pytest

from eval.quadrotor.vehicle_file import load_vehicle
from policies.spec import ActionSpec, DepthEncoding, PolicySpec

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the renderers that dm_control looks for
    from eval.envs.dm_control_env import load

VEHICLE = load_vehicle("racer5")
SLOW = replace(VEHICLE, controller=replace(VEHICLE.controller, frequency=200.0))


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (PolicySpec(action=ActionSpec("ctbr")), "spec.action is .*ctbr.* allowed is acceleration"),
        (PolicySpec(action=ActionSpec(scale=(20.0,))), "spec.action is .*20.* SI units"),
        (PolicySpec(depth=DepthEncoding(channel_axis=True)), "spec.depth is .* channel_axis=False"),
        (PolicySpec(depth=DepthEncoding(uint8=True)), "spec.depth is .* uint8=False"),
        (PolicySpec(rate_hz=300.0), "spec.rate_hz is 300, allowed is up to the 200 Hz"),
    ],
)
def test_dm_control_refuses_a_spec_that_it_would_ignore(spec, said):
    with pytest.raises(ValueError, match=said):
        load(vehicle=SLOW, spec=spec)


@pytest.mark.parametrize("action", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -20.1], [0, 0]])
def test_dm_control_refuses_a_bad_action(action):
    env = load()
    env.reset()
    with pytest.raises(ValueError, match=r"action is \[.*allowed are 3 numbers from -20 to 20"):
        env.step(np.array(action))
