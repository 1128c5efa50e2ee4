"""The environments under the wrappers and checkers of the libraries that people train with."""

import importlib.util
import sys
import types
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv
from gymnasium.wrappers import FlattenObservation, FrameStackObservation, RecordVideo

from eval.envs.gymnasium_env import ID, RaceEnv
from eval.view import colours
from eval.worlds.trial import Rules
from policies.spec import PolicySpec
from tests.support.pixels import share
from tracks.geometry.camera import Camera

SHORT = Rules(time_limit_s=0.3)
sb3 = pytest.mark.skipif(
    importlib.util.find_spec("stable_baselines3") is None,
    reason="pip install 'diffracing-suite[sb3]'",
)


def test_processes_fly_what_one_process_flies():
    def make():
        return RaceEnv(track="circular", level=3, rules=SHORT)

    seen = []
    # A process that has loaded JAX runs threads, and must not be forked.
    for kind, how in ((AsyncVectorEnv, {"context": "spawn"}), (SyncVectorEnv, {})):
        env = kind([make, make], **how)
        first, _ = env.reset(seed=4)
        steps = [env.step(np.full((2, 3), 0.1, np.float32))[0] for _ in range(3)]
        seen.append([first, *steps])
        env.close()
    for one, other in zip(*seen, strict=True):
        assert all(np.array_equal(one[key], other[key]) for key in one)
    assert not np.array_equal(seen[0][0]["image"][0], seen[0][0]["image"][1])


def test_a_picture_shows_the_track_from_behind_the_drone_and_what_it_sees():
    with pytest.raises(RuntimeError, match=r"reset\(\) before render"):
        RaceEnv(render_mode="rgb_array").render()
    env = RaceEnv(track="circular", track_seed=1, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture is not None and (picture.shape, picture.dtype) == ((360, 640, 3), np.uint8)
    assert share(picture, colours.AHEAD, 50) > 3e-3 and share(picture, colours.DRONE, 12) > 5e-4
    depth_m = env._races.view().depth_m[0]
    want = colours.depth_colours(depth_m, env.spec_of_policy.camera.range_m)
    np.testing.assert_array_equal(picture[-120:, -160:][2::5, 2::5], want)
    env.reset(options={"track_seed": 2})
    fresh = RaceEnv(track="circular", track_seed=2, render_mode="rgb_array")
    fresh.reset(seed=0)
    assert np.array_equal(env.render(), fresh.render())  # pyright: ignore[reportArgumentType]
    assert RaceEnv().render() is None


def test_record_video_records_an_episode(tmp_path, monkeypatch):
    clips = []

    class Clip:
        """Stands for moviepy's where that is not installed."""

        def __init__(self, frames, fps):
            clips.append((frames, fps))

        def write_videofile(self, path, logger):
            open(path, "w").close()

    if importlib.util.find_spec("moviepy") is None:
        clip = types.ModuleType("moviepy.video.io.ImageSequenceClip")
        clip.ImageSequenceClip = Clip  # pyright: ignore[reportAttributeAccessIssue]
        for name in ("moviepy", "moviepy.video", "moviepy.video.io"):
            monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
        monkeypatch.setitem(sys.modules, clip.__name__, clip)
    env = gymnasium.make(ID, render_mode="rgb_array", rules=SHORT)
    env = RecordVideo(env, str(tmp_path / "new"), episode_trigger=lambda episode: episode == 0)
    env.reset(seed=0)
    steps, over = 0, False
    while not over:
        _, _, terminated, truncated, _ = env.step(np.array([0.5, 0.0, 0.1], np.float32))
        over, steps = terminated or truncated, steps + 1
    env.close()
    (video,) = tmp_path.glob("new/*.mp4")
    assert video.name == "rl-video-episode-0.mp4"
    if clips:
        ((frames, fps),) = clips
        assert len(frames) == steps + 1 and fps == 30
        assert not np.array_equal(frames[0], frames[-1])
    else:
        assert video.stat().st_size > 1000


def test_wrappers_flatten_and_stack_what_is_seen():
    env = FrameStackObservation(FlattenObservation(RaceEnv(rules=SHORT)), 2)
    seen, _ = env.reset(seed=0)
    assert seen.shape == (2, 12 + 24 * 32) and env.observation_space.contains(seen)


@sb3
@pytest.mark.parametrize("how", ["vector", "pixels"])
def test_the_checker_of_stable_baselines3_finds_nothing(how):
    from stable_baselines3.common.env_checker import check_env  # pyright: ignore

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
    assert many.get_attr("contract")[0] == singles[0].unwrapped.contract
