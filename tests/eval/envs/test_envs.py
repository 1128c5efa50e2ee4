"""The environments by their libraries' own checkers, and against the judge."""

import os
import warnings

os.environ.setdefault("MUJOCO_GL", "disable")

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env

from eval.envs.race import ACTION_LIMIT
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.pilots import Pursuit
from tracks.families import make_track

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the renderers that dm_control looks for
    from eval.envs.dm_control_env import load

from eval.envs.gymnasium_env import ID, RaceEnv

EVEN = PolicySpec(rate_hz=50.0)  # a whole number of physics steps, so that the judge flies alike


def test_gymnasium_checker():
    check_env(gymnasium.make(ID, rules=Rules(time_limit_s=0.5)).unwrapped)


def test_gymnasium_tracks_are_set_by_the_seed():
    env = RaceEnv(track="circular", level=5, rules=Rules(time_limit_s=0.2))
    first, info = env.reset(seed=3)
    again, info_again = env.reset(seed=3)
    assert info == info_again and all(np.array_equal(first[k], again[k]) for k in first)
    other, info_other = env.reset()
    assert info_other != info and not np.array_equal(first["image"], other["image"])
    _, chosen = env.reset(options={"track_seed": 12})
    assert chosen["track_seed"] == 12


def test_step_before_reset_is_refused():
    with pytest.raises(RuntimeError, match="reset"):
        RaceEnv().step(np.zeros(3, np.float32))


class TestDmControl(test_utils.EnvironmentTestMixin, absltest.TestCase):
    """dm_env's own conformance tests."""

    def make_object_under_test(self, **unused):
        return load(rules=Rules(time_limit_s=0.5))

    def make_action_sequence(self):
        spec = self.environment.action_spec()
        rng = np.random.default_rng(0)
        for _ in range(40):
            yield rng.uniform(spec.minimum, spec.maximum)


def pursue(policy, observation):
    state, image = observation["state"][None], observation["image"][None]
    action, _ = policy.act(policy.start(1), state, image, np.zeros(1, bool))
    return action[0]


def judged(policy, trial, rules):
    (result,) = fly(
        policy, [trial], load_vehicle("reference"), options=JudgeOptions(slots=1, rules=rules)
    )
    return result


@pytest.mark.parametrize(
    ("trial", "spec"),
    [
        (TrialSpec("ellipse", 0, 0), EVEN),
        (TrialSpec("circular", 9, 1), EVEN),
        (TrialSpec("circular", 9, 1), PolicySpec()),
    ],
)
def test_environments_fly_what_the_judge_flies(trial, spec):
    rules, policy = Rules(time_limit_s=1.6), Pursuit(spec=spec)
    expected = judged(policy, trial, rules)

    env = RaceEnv(
        track=trial.track, level=trial.difficulty, track_seed=trial.seed, spec=spec, rules=rules,
        vehicle="reference",
    )  # fmt: skip
    observation, _ = env.reset()
    over, terminated, info, total = False, False, {}, 0.0
    while not over:
        observation, reward, terminated, truncated, info = env.step(
            pursue(policy, observation) / ACTION_LIMIT
        )
        over, total = terminated or truncated, total + reward
    assert (info["gates"], info["ended_by"]) == (expected.gates_passed, expected.ended_by)
    assert terminated == (expected.ended_by != "timeout")
    end = np.array([expected.pos_x, expected.pos_y, expected.pos_z])
    # The action was divided and multiplied on its way.
    assert env._races._world.progress.pos_w[0] == pytest.approx(end, abs=1e-5)

    if spec is not EVEN:  # dm_control's period is one number of steps
        return
    other = load(*trial, spec=EVEN, rules=rules)
    step = other.reset()
    summed = 0.0
    while not step.last():
        step = other.step(pursue(policy, step.observation))
        summed += step.reward
    assert step.discount == (1.0 if expected.ended_by == "timeout" else 0.0)
    assert np.array_equal(other.physics.race.progress.pos_w[0], end)
    assert summed == pytest.approx(total, abs=1e-4)


def test_a_crash_costs_and_progress_pays():
    env = RaceEnv(track="zigzag", track_seed=0)
    env.reset()
    down = np.array([0, 0, -1], np.float32)
    rewards, over, info = [], False, {}
    while not over:
        _, reward, over, _, info = env.step(down)
        rewards.append(reward)
    assert rewards[-1] < rewards[-2] - 0.8 and info["ended_by"] in ("collision", "tipped")

    start, _ = env.reset()
    policy, total = Pursuit(), 0.0
    observation = start
    for _ in range(30):
        observation, reward, *_ = env.step(pursue(policy, observation) / ACTION_LIMIT)
        total += reward
    before, after = (np.linalg.norm(o["state"][6:9]) for o in (start, observation))
    assert total == pytest.approx(before - after, abs=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_action_that_is_not_finite_ends_the_episode_with_a_message(value):
    env = RaceEnv(track="zigzag", track_seed=0)
    env.reset()
    seen, reward, terminated, truncated, info = env.step(np.full(3, value, np.float32))
    assert (terminated, truncated, info["ended_by"]) == (True, False, "bad_action")
    assert "not finite" in info["message"] and reward == -1.0
    assert np.isfinite(seen["state"]).all()
    with pytest.raises(RuntimeError, match="ended by bad_action: call reset"):
        env.step(np.zeros(3, np.float32))
    env.reset()
    env.step(np.full(3, 1e30, np.float32))


def test_an_action_beyond_the_space_is_its_nearest_within():
    env, seen = RaceEnv(track="zigzag", track_seed=0), []
    for ahead in (1.0, 1.7):
        env.reset(seed=0)
        seen.append(env.step(np.array([ahead, 0.2, 0.3], np.float32))[0]["state"])
    assert np.array_equal(*seen)


def test_the_second_gate_and_the_direction_are_shown_where_asked_for():
    spec = PolicySpec(second_gate=True, gate_axis=True, second_axis=True)
    env = RaceEnv(track="zigzag", track_seed=1, spec=spec)
    seen, _ = env.reset(seed=0)
    state = seen["state"]
    assert env.observation_space.contains(seen) and state.shape == (21,)
    assert np.linalg.norm(state[12:15] - state[6:9]) > 3.0
    np.testing.assert_allclose(state[15:18], [1, 0, 0], atol=0.3)  # at rest before the first gate
    track = make_track("zigzag", 0, 1)
    assert state[18:] @ state[15:18] == pytest.approx(
        track.scene.gates.rot_w[1, :, 0] @ track.scene.gates.rot_w[0, :, 0], abs=1e-6
    )
