"""Every world shows what a policy asks for beyond the twelve numbers, and nothing else."""

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from eval.envs.gymnasium_env import RaceEnv
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import straight
from tests.support.pilots import Pursuit
from tracks.geometry.camera import Camera

VEHICLE = load_vehicle("reference")
DISTANCES = (1.0, 2.5, 4.5)


@dataclass
class Witness(Pursuit):
    """A pursuit that keeps what it was shown."""

    seen: list = field(default_factory=list)

    def act(self, hidden, state, image, fresh):
        self.seen.append(state[0].copy())
        return super().act(hidden, state, image, fresh)


def shown(world, **more):
    camera = Camera(width=20, height=20)
    policy = Witness(spec=replace(PolicySpec(camera=camera), **more))
    options = JudgeOptions(slots=1, rules=Rules(time_limit_s=3.0))
    tracks = {"straight": straight(DISTANCES)}
    result = fly(policy, [TrialSpec("straight", 0, 0)], VEHICLE, world, options, tracks=tracks)[0]
    assert result.ended_by == "finished"
    return np.array(policy.seen)


@pytest.mark.parametrize("world", ["mujoco", "reference", "mjx"])
def test_the_second_gate_and_the_direction_are_those_of_a_line_of_gates(world):
    """Level gates on a line: centres differ by the stretch, and the direction is along the line."""
    states = shown(world, second_gate=True, gate_axis=True)
    assert states.shape[1] == 18
    gate, second, axis = states[:, 6:9], states[:, 12:15], states[:, 15:]
    distance = np.linalg.norm(gate, axis=-1)
    stretch = np.linalg.norm(second - gate, axis=-1)
    number = np.cumsum(np.diff(distance, prepend=9.0) > 0.5)
    expected = np.array([*np.diff(DISTANCES), 0.0])
    assert set(number) == {0, 1, 2}
    np.testing.assert_allclose(stretch, expected[number], atol=1e-4)
    ahead = number < 2
    assert np.all(second[ahead, 0] > gate[ahead, 0] + 0.5)
    # From gate to gate is the direction itself, in whatever axes.
    np.testing.assert_allclose(
        (second - gate)[ahead], stretch[ahead, None] * axis[ahead], atol=1e-4
    )
    np.testing.assert_allclose(np.linalg.norm(axis, axis=-1), 1.0, atol=1e-5)


@pytest.mark.parametrize("more", [{"second_gate": True}, {"gate_axis": True}])
def test_each_comes_alone_as_well(more):
    states = shown("reference", **more)
    assert states.shape[1] == 15
    length = np.linalg.norm(states[0, 12:])
    assert length == pytest.approx(DISTANCES[1] if "second_gate" in more else 1.0, abs=0.6)


@pytest.mark.parametrize("world", ["mujoco", "reference"])
def test_others_are_shown_the_papers_twelve_numbers(world):
    assert shown(world).shape[1] == 12


def test_the_environment_shows_it_too():
    env = RaceEnv("zigzag", 0, 1, spec=PolicySpec(second_gate=True, gate_axis=True))
    seen, _ = env.reset(seed=0)
    state = seen["state"]
    assert env.observation_space.contains(seen) and state.shape == (18,)
    assert np.linalg.norm(state[12:15] - state[6:9]) > 3.0
    np.testing.assert_allclose(state[15:], [1, 0, 0], atol=0.3)  # at rest before the first gate
