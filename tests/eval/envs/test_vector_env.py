"""The environments by gymnasium's conventions: registered, vectorised, copied, rendered."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from eval.envs.gymnasium_env import ID, RaceEnv, RaceVectorEnv
from eval.envs.races import REWARDS
from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import with_effects
from eval.worlds.trial import Rules, TrialSpec
from policies.contract import read_contract
from tests.support.pilots import Pursuit

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


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"rewards": {"gates": 1.0}}, "unknown reward term 'gates'. Did you mean 'gate'"),
        ({"level": (3, 0)}, r"level is \(3, 0\), allowed is 0 to 9"),
        ({"level": 10}, "level is 10, allowed is 0 to 9"),
        ({"spec": "raec"}, "unknown policy .* 'raec'. Did you mean 'race'"),
        ({"num_envs": 0}, "num_envs is 0, allowed is 1 or more"),
    ],
)
def test_what_cannot_be_flown_is_refused_when_it_is_made(settings, said):
    with pytest.raises(ValueError, match=said):
        RaceVectorEnv(**settings)


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


def test_a_policy_flies_in_environment_and_judge_alike():
    rules = Rules(time_limit_s=2.0)
    env = RaceVectorEnv(2, track="ellipse", vehicle="reference", rules=rules)
    policy = Pursuit(spec=env._races.spec)
    inner = policy.act
    policy.act = lambda *inputs: (inner(*inputs)[0] / np.float32(20), inputs[0])
    trials = [TrialSpec("ellipse", 0, seed) for seed in (4, 5)]
    judged = fly(policy, trials, load_vehicle("reference"), options=JudgeOptions(rules=rules))
    env._races.start([0], [np.random.default_rng(0)], 4)
    env._rngs = [np.random.default_rng(0)] * 2
    env._races.start([1], [np.random.default_rng(0)], 5)
    seen, over, info = env._races.observation(), np.zeros(2, bool), {}
    gates = {}
    while not over.all():
        action, _ = policy.act(None, seen["state"], seen["image"], np.zeros(2, bool))
        seen, _, terminated, truncated, info = env.step(action)
        for k in np.flatnonzero((terminated | truncated) & ~over):
            gates[k] = (info["final_info"]["gates"][k], info["final_info"]["ended_by"][k])
        over |= terminated | truncated
    assert [gates[k] for k in (0, 1)] == [(r.gates_passed, r.ended_by) for r in judged]
