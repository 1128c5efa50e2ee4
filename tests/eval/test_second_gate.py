"""Every world shows the gate after the next one to policies that ask for it, and to no others."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv
from eval.judge import JudgeOptions, fly
from eval.trial import Rules, TrialSpec
from eval.vehicle_file import load_vehicle
from policies.spec import PolicySpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit
from tracks.camera import Camera

VEHICLE = load_vehicle("reference")
DISTANCES = (1.0, 2.5, 4.5)


@dataclass
class Witness(Pursuit):
    """A pursuit that keeps what it was shown."""

    seen: list = field(default_factory=list)

    def act(self, hidden, state, image, fresh):
        self.seen.append(state[0].copy())
        return super().act(hidden, state, image, fresh)


def shown(world, second_gate):
    camera = Camera(width=20, height=20)
    policy = Witness(spec=replace(PolicySpec(camera=camera), second_gate=second_gate))
    options = JudgeOptions(slots=1, rules=Rules(time_limit_s=3.0))
    tracks = {"straight": straight(DISTANCES)}
    result = fly(policy, [TrialSpec("straight", 0, 0)], VEHICLE, world, options, tracks=tracks)[0]
    assert result.ended_by == "finished"
    return np.array(policy.seen)


@pytest.mark.parametrize("world", ["mujoco", "plain", "mjx"])
def test_the_second_gate_lies_a_stretch_behind_the_next(world):
    """Level gates on a line: their centres differ by the stretch, in whatever axes."""
    states = shown(world, True)
    assert states.shape[1] == 15
    stretch = np.linalg.norm(states[:, 12:] - states[:, 6:9], axis=-1)
    number = np.cumsum(np.diff(np.linalg.norm(states[:, 6:9], axis=-1), prepend=9.0) > 0.5)
    expected = np.array([*np.diff(DISTANCES), 0.0])
    assert set(number) == {0, 1, 2}
    np.testing.assert_allclose(stretch, expected[number], atol=1e-4)
    ahead = states[number < 2]
    assert np.all(ahead[:, 12] > ahead[:, 6] + 0.5)


@pytest.mark.parametrize("world", ["mujoco", "plain"])
def test_others_are_shown_the_papers_twelve_numbers(world):
    assert shown(world, False).shape[1] == 12


def test_the_environment_shows_it_too():
    env = RaceEnv("zigzag", 0, 1, spec=PolicySpec(second_gate=True))
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen) and seen["state"].shape == (15,)
    assert np.linalg.norm(seen["state"][12:] - seen["state"][6:9]) > 3.0
