"""The environments by the conventions and checkers of libraries, and against the judge."""

import copy
import importlib.util
import os
import pickle
import warnings
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "disable")

import gymnasium
import numpy as np
import pytest
from absl.testing import absltest
from dm_env import test_utils
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, FrameStackObservation

from eval.envs.gymnasium_env import ID, RaceEnv, RaceVectorEnv
from eval.envs.race import ACTION_LIMIT
from eval.envs.races import REWARDS
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from eval.vehicles.vehicle import with_effects
from eval.view import colours
from eval.worlds.trial import Rules, TrialSpec
from policies.contract import read_contract
from policies.spec import PolicySpec
from tests.support.courses import ONE_GATE, end_of
from tests.support.marks import more
from tests.support.pilots import Pursuit
from tests.support.pixels import share
from tracks.geometry.camera import Camera

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the renderers that dm_control looks for
    from eval.envs.dm_control_env import load

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
        for _ in range(20):
            yield rng.uniform(spec.minimum, spec.maximum)


def pursue(policy, observation):
    state, image = observation["state"][None], observation["image"][None]
    action, _ = policy.act(policy.start(1), state, image, np.zeros(1, bool))
    return action[0]


@pytest.mark.parametrize(
    ("trial", "spec"),
    [
        more(TrialSpec("ellipse", 0, 0), EVEN),
        (TrialSpec("circular", 9, 1), EVEN),
        more(TrialSpec("circular", 9, 1), PolicySpec()),
    ],
)
def test_environments_fly_what_the_judge_flies(trial, spec):
    rules, policy = Rules(time_limit_s=1.0), Pursuit(spec=spec)
    options = JudgeOptions(slots=1, rules=rules)
    (expected,) = fly(policy, [trial], load_vehicle("reference"), options=options)
    env = RaceEnv(
        track=trial.track, level=trial.difficulty, track_seed=trial.seed, spec=spec, rules=rules,
        vehicle="reference",
    )  # fmt: skip
    observation, _ = env.reset()
    over, terminated, info, total = False, False, {}, 0.0
    while not over:
        action = pursue(policy, observation) / ACTION_LIMIT
        observation, reward, terminated, truncated, info = env.step(action)
        over, total = terminated or truncated, total + reward
    assert (info["gates"], info["ended_by"]) == (expected.gates_passed, expected.ended_by)
    assert terminated == (expected.ended_by != "timeout")
    # The action was divided and multiplied on its way.
    assert env._races._world.progress.pos_w[0] == pytest.approx(end_of(expected), abs=1e-5)

    if spec is not EVEN:  # dm_control's period is one number of steps
        return
    other = load(*trial, spec=EVEN, rules=rules)
    step = other.reset()
    summed = 0.0
    while not step.last():
        step = other.step(pursue(policy, step.observation))
        summed += step.reward
    assert step.discount == (1.0 if expected.ended_by == "timeout" else 0.0)
    assert np.array_equal(other.physics.race.progress.pos_w[0], end_of(expected))
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
    for size in (9.81, 1e30):
        with pytest.warns(UserWarning, match="actions are from -1 to 1; env.contract has"):
            env.step(np.full(3, size, np.float32))


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


SHORT = Rules(time_limit_s=0.3)


def test_n_at_once_give_the_bits_of_n_single_ones_through_resets():
    settings = {"track": "circular", "level": (0, 9), "rules": SHORT, "action": "ctbr"}
    many = RaceVectorEnv(3, **settings)
    singles = [RaceEnv(**settings) for _ in range(3)]
    seen, _ = many.reset(seed=5)
    alone = [env.reset(seed=5 + k)[0] for k, env in enumerate(singles)]
    rng, ended = np.random.default_rng(0), 0
    for _ in range(14):
        for k in range(3):
            assert all(np.array_equal(seen[key][k], alone[k][key]) for key in seen)
        actions = rng.uniform(-1, 1, (3, 4)).astype(np.float32)
        seen, reward, terminated, truncated, info = many.step(actions)
        for k, env in enumerate(singles):
            alone[k], one, term, trunc, told = env.step(actions[k])
            assert (one, term, trunc) == (reward[k], terminated[k], truncated[k])
            if term or trunc:
                ended += 1
                last = info["final_obs"][k]
                assert all(np.array_equal(last[key], alone[k][key]) for key in last)
                assert info["final_info"]["ended_by"][k] == told["ended_by"]
                alone[k], _ = env.reset()
    assert ended >= 3 and many.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP


def test_it_is_made_by_its_id_alone_and_many_at_once():
    env = gymnasium.make(ID, track="zigzag", rules=SHORT)
    assert isinstance(env.unwrapped, RaceEnv)
    many = gymnasium.make_vec(ID, num_envs=2, rules=SHORT)
    assert isinstance(many, RaceVectorEnv)
    assert many.observation_space["state"].shape == (2, 12)


def test_images_on_request_are_uint8_with_a_channel_axis():
    env = RaceEnv(track="circular", track_seed=1, uint8=True, channel_axis=True)
    seen, _ = env.reset(seed=0)
    assert env.observation_space.contains(seen)
    image = seen["image"]
    assert (image.shape, image.dtype) == ((1, 24, 32), np.uint8) and image.max() > image.min()
    plain, _ = RaceEnv(track="circular", track_seed=1).reset(seed=0)
    low, high = -0.3, 9.4
    np.testing.assert_allclose(image[0] / 255 * (high - low) + low, plain["image"], atol=0.02)
    assert read_contract(env.contract.text, "env") == env.contract


def test_rewards_are_terms_by_name():
    settings = {"track": "circular", "track_seed": 1, "rules": SHORT}
    nothing = dict.fromkeys(REWARDS, 0.0)
    for weights, expected in ((nothing, 0.0), ({**nothing, "time": -2.0}, -2 * 17 * 0.002)):
        env = RaceEnv(**settings, rewards=weights)
        env.reset(seed=0)
        assert env.step(np.zeros(3, np.float32))[1] == pytest.approx(expected)


def test_each_episode_may_draw_its_vehicle_and_its_level():
    drawn = []

    def vehicle(rng):
        drawn.append(rng.uniform())
        return with_effects(load_vehicle("racer5"), {})

    env = RaceVectorEnv(2, vehicle=vehicle, level=(2, 4), rules=SHORT)
    _, info = env.reset(seed=0)
    assert len(set(drawn)) >= 2 and set(info["level"]) <= {2, 3, 4}
    env.step(np.zeros((2, 3), np.float32))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_environments_and_vehicles_travel(copied):
    vehicle = load_vehicle("reference")
    assert copied(vehicle) == vehicle
    env = RaceEnv(track="circular", vehicle=vehicle, rules=SHORT, render_mode="rgb_array")
    first, _ = env.reset(seed=3)
    again = copied(env)
    second, _ = again.reset(seed=3)
    assert np.array_equal(first["image"], second["image"])
    assert again.render().shape == (360, 640, 3) and again.render().max() > 0
    assert copied(RaceVectorEnv(2, rules=SHORT)).num_envs == 2


def test_a_copy_reads_the_files_of_its_environment_in_another_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "course.toml").write_text(ONE_GATE)
    save_vehicle(load_vehicle("racer5"), "mine.toml")
    (tmp_path / "race").mkdir()  # a name of the suite stays a name
    files = {"track": "course.toml", "vehicle": Path("mine.toml"), "spec": "race"}
    envs = [RaceEnv(rules=SHORT, **files), RaceVectorEnv(1, rules=SHORT, **files)]
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path / "other")
    for env in envs:
        assert all(
            np.array_equal(*pair)
            for pair in zip(
                *(copied.reset(seed=1)[0].values() for copied in (env, copy.deepcopy(env))),
                strict=True,
            )
        )


def test_a_tensor_is_an_action_without_a_warning():
    import torch

    env = RaceEnv(rules=SHORT)
    env.reset(seed=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env.step(torch.zeros(3))


@pytest.mark.slow
def test_processes_fly_what_one_process_flies():
    def make():
        return RaceEnv(track="circular", level=3, rules=SHORT)

    # A process that has loaded JAX runs threads, and must not be forked.
    envs = AsyncVectorEnv([make, make], context="spawn"), SyncVectorEnv([make, make])
    firsts = [env.reset(seed=4)[0] for env in envs]
    assert not np.array_equal(firsts[0]["image"][0], firsts[0]["image"][1])
    for _ in range(3):
        one, other = (env.step(np.full((2, 3), 0.1, np.float32))[0] for env in envs)
        assert all(np.array_equal(one[key], other[key]) for key in one)
    for env in envs:
        env.close()


def test_wrappers_flatten_and_stack_observations():
    env = FrameStackObservation(FlattenObservation(RaceEnv(rules=SHORT)), 2)
    seen, _ = env.reset(seed=0)
    assert seen.shape == (2, 12 + 24 * 32) and env.observation_space.contains(seen)


sb3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="pip install 'diffracing-suite[sb3]'",
)


def test_a_picture_shows_the_track_from_behind_the_drone_and_what_it_sees():
    with pytest.raises(RuntimeError, match=r"reset\(\) before render"):
        RaceEnv(render_mode="rgb_array").render()
    env = RaceEnv(track="circular", track_seed=1, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None and (picture.shape, picture.dtype) == ((360, 640, 3), np.uint8)
    assert share(picture, colours.AHEAD, 50) > 3e-3 and share(picture, colours.DRONE, 12) > 5e-4
    depth_m = env._races.view().depth_m[0]
    want = colours.depth_colours(depth_m, env._races.spec.camera.range_m)
    np.testing.assert_array_equal(picture[-120:, -160:][2::5, 2::5], want)
    env.reset(options={"track_seed": 2})
    fresh = RaceEnv(track="circular", track_seed=2, render_mode="rgb_array")
    fresh.reset(seed=0)
    assert np.array_equal(env.render(), fresh.render())
    assert RaceEnv().render() is None and env.metadata["render_fps"] == 30


@sb3
@pytest.mark.parametrize("how", ["vector", "pixels"])
def test_the_checker_of_stable_baselines3_finds_nothing(how):
    from stable_baselines3.common.env_checker import check_env

    from eval.envs.sb3_env import race_env

    settings = {"rules": SHORT, "render_mode": "rgb_array"}
    if how == "pixels":  # its networks for images ask for 36 pixels and more
        spec = replace(PolicySpec(), camera=Camera(width=48, height=36))
        settings |= {"spec": spec, "uint8": True, "channel_axis": True}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(race_env(**settings))


@sb3
def test_its_vector_environment_is_ours():
    from eval.envs.sb3_env import RaceVecEnv, race_env

    many = RaceVecEnv(2, track="circular", rules=SHORT)
    singles = [race_env(track="circular", rules=SHORT) for _ in range(2)]
    assert many.observation_space == singles[0].observation_space
    assert many.observation_space["image"].shape == (24 * 32,)
    many.seed(7)
    seen = many.reset()
    alone = [env.reset(seed=7 + k)[0] for k, env in enumerate(singles)]
    over = np.zeros(2, bool)
    while not over.any():
        for k in range(2):
            assert all(np.array_equal(seen[key][k], alone[k][key]) for key in seen)
        actions = np.full((2, 3), 0.05, np.float32)
        seen, reward, over, infos = many.step(actions)
        steps = [env.step(action) for env, action in zip(singles, actions, strict=True)]
        alone = [each[0] for each in steps]
        assert reward.tolist() == pytest.approx([each[1] for each in steps])
    for k in np.flatnonzero(over):
        last = infos[k]["terminal_observation"]
        assert all(np.array_equal(last[key], alone[k][key]) for key in last)
        assert infos[k]["TimeLimit.truncated"] and infos[k]["ended_by"] == "timeout"
        assert many.reset_infos[k]["track_seed"] != infos[k]["track_seed"]
    assert many.get_attr("contract")[0] == singles[0].unwrapped.contract
    many.set_options({"track_seed": 12})
    for fixed in (True, False):  # options hold for one reset
        many.reset()
        assert ([info["track_seed"] for info in many.reset_infos] == [12, 12]) is fixed
    many.set_options([{"track_seed": 1}, {"track_seed": 2}])
    with pytest.raises(ValueError, match="options are .* allowed is one dict for all"):
        many.reset()
