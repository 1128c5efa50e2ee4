"""Settings, actions and seeds that the environments refuse or accept."""

import math
import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")

import numpy as np
import pytest

import suite
import tracks
from eval.effects.thrust import BatterySag
from eval.effects.wind import Gusts
from eval.envs.gymnasium_env import RaceEnv, RaceVectorEnv
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import with_effects
from eval.worlds.trial import Rules
from policies.spec import ActionSpec, DepthEncoding, PolicySpec
from tests.support.courses import IN_CONTACT
from tracks.formats.custom import load_track

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of the renderers that dm_control looks for
    from eval.envs.dm_control_env import load

VEHICLE = load_vehicle("racer5")
SLOW = replace(VEHICLE, controller=replace(VEHICLE.controller, frequency=200.0))


@pytest.mark.parametrize("action", [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -20.1], [0, 0]])
def test_dm_control_refuses_a_bad_action(action):
    env = load()
    env.reset()
    with pytest.raises(ValueError, match=r"action is \[.*allowed are 3 numbers from -20 to 20"):
        env.step(np.array(action))


BAD_MODE: Any = ["human"]
CTBR = PolicySpec(action=ActionSpec("ctbr"))


REFUSED = {
    load: [
        ({"spec": CTBR}, "spec.action is .*ctbr.* allowed is acceleration"),
        ({"spec": PolicySpec(action=ActionSpec(scale=(20.0,)))}, "spec.action is .*20.* SI units"),
        ({"spec": PolicySpec(depth=DepthEncoding(channel_axis=True))}, "channel_axis=False"),
        ({"spec": PolicySpec(depth=DepthEncoding(uint8=True))}, "spec.depth is .* uint8=False"),
        (
            {"spec": PolicySpec(rate_hz=300.0), "vehicle": SLOW},
            "the spec decides at 300 Hz; .* 200 Hz",
        ),
        ({"track": "zigzag"}, "track is 'zigzag', allowed is a Track or None"),
        ({"vehicle": "racer5"}, "vehicle is 'racer5', allowed is a Vehicle or None"),
        ({"spec": "race"}, "spec is 'race', allowed is a PolicySpec or None"),
        ({"rules": {}}, "rules is {}, allowed is an eval.worlds.trial.Rules"),
        ({"rules": Rules(rate_limit=-1.0)}, "rules.rate_limit is -1.0, allowed is above 0"),
    ],
    RaceVectorEnv: [
        ({"rewards": {"gates": 1.0}}, "unknown reward term 'gates'. Did you mean 'gate'"),
        ({"level": (3, 0)}, r"level is \(3, 0\), allowed is 0 to 9"),
        ({"level": "3"}, "level is '3', allowed is 0 to 9"),
        ({"vehicle": {}}, "vehicle is {}, allowed is a name"),
        ({"vehicle": replace(SLOW, mass=-1.0)}, r"mass = -1\.0: must be"),
        ({"vehicle": lambda rng: replace(SLOW, mass=0.0)}, r"mass = 0\.0: must be"),
        ({"vehicle": lambda rng: "racer5"}, "vehicle is 'racer5', allowed is a Vehicle"),
        ({"track": ["zigzag"]}, r"track is \['zigzag'\], allowed is a track family or"),
        ({"rewards": {"gate": "x"}}, r"rewards\['gate'\] is 'x', allowed is a number"),
        ({"rewards": {"gate": math.nan}}, r"rewards\['gate'\] is nan, allowed is -1000000 to"),
        ({"rules": Rules(time_limit_s=0.0)}, "rules.time_limit_s is 0.0, allowed is above 0"),
        ({"level": 10}, "level is 10, allowed is 0 to 9"),
        ({"spec": "raec"}, "unknown policy .* 'raec'. Did you mean 'race'"),
        ({"num_envs": 0}, "num_envs is 0, allowed is a whole number, 1 or more"),
        ({"num_envs": 1.5}, "num_envs is 1.5, allowed is a whole number, 1 or more"),
        ({"threads": "2"}, "threads is '2', allowed is a whole number, 1 or more"),
        ({"action": ["ctbr"]}, r"action is \['ctbr'\], allowed is a kind of action"),
        ({"uint8": "no"}, "uint8 is 'no', allowed is True or False"),
    ],
    RaceEnv: [
        ({"spec": PolicySpec(rate_hz=0.0)}, "spec.rate_hz.* is 0"),
        (
            {"spec": PolicySpec(rate_hz=300.0), "vehicle": SLOW},
            "the spec decides at 300 Hz; .* 200 Hz",
        ),
        ({"spec": PolicySpec(action=ActionSpec("ctbr", (1.0, 2.0)))}, "action.scale is .*1 or 4"),
        ({"spec": PolicySpec(action=ActionSpec("ctbt"))}, "unknown kind of action 'ctbt'"),
        ({"spec": CTBR, "action": "motors"}, "action is 'motors', allowed is the spec's 'ctbr'"),
        ({"spec": CTBR, "action": "acceleration"}, "'acceleration', allowed is the spec's 'ctbr'"),
        ({"level": (1, 2, 3)}, r"level is \(1, 2, 3\), allowed is 0 to 9"),
        ({"level": (1,)}, r"level is \(1,\), allowed is 0 to 9"),
        ({"level": (1.5, 2)}, r"level is \(1.5, 2\), allowed is 0 to 9"),
        ({"level": 2.5}, "level is 2.5, allowed is 0 to 9"),
    ],
}


@pytest.mark.parametrize(
    ("make", "settings", "said"),
    [(make, *refusal) for make, refusals in REFUSED.items() for refusal in refusals],
)
def test_settings_that_cannot_be_used_are_refused(make, settings, said):
    with pytest.raises(ValueError, match=said):
        make(**settings)


def test_an_unknown_argument_is_refused_with_the_most_similar_one():
    for name, known in (("difficulty", "level"), ("tracks", "track")):
        with pytest.raises(TypeError, match=f"unknown argument '{name}'. Did you mean '{known}'"):
            RaceEnv(**{name: 3})


def test_flags_of_the_spec_and_of_the_environment_are_joined():
    spec = PolicySpec(depth=DepthEncoding(channel_axis=True), action=ActionSpec("ctbr"))
    env = RaceEnv(spec=spec, uint8=True)
    image = env.observation_space["image"]
    assert (image.shape, image.dtype) == ((1, 24, 32), np.uint8)
    assert env.action_space.shape == (4,) == RaceEnv(action="ctbr").action_space.shape


def test_paths_and_numpy_numbers_are_taken():
    file = Path(tracks.__path__[0]) / "examples" / "yard.toml"
    given = {"vehicle": Path("reference"), "spec": Path("race"), "level": np.int64(3)}
    assert RaceEnv(**given).reset(seed=0)[1]["level"] == 3
    with pytest.warns(UserWarning, match="no levels and seeds: (level|track_seed) does not change"):
        RaceEnv(track=file, track_seed=1, **given)
    assert RaceEnv(level=np.array([2, 2])).reset(seed=0)[1]["level"] == 2


def test_gusts_on_a_track_file_are_those_of_its_only_level_as_in_the_judge(tmp_path):
    path = tmp_path / "gate.toml"
    path.write_text("[[gates]]\ncenter = [0, 0, 1.3]\nwidth = 1\nheight = 1\n")
    vehicle = with_effects(load_vehicle("reference"), {"gusts": Gusts(3.0, 5.0)})
    reached = []
    for level in (0, 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the level has no effect
            env = RaceEnv(track=path, level=level, track_seed=7, vehicle=vehicle)
        assert env.reset(seed=0)[1]["level"] == 0
        reached.append([env.step(np.zeros(3, np.float32))[0]["state"] for _ in range(5)])
    np.testing.assert_array_equal(*reached)


def test_a_track_on_which_the_vehicle_starts_in_contact_is_refused(tmp_path):
    (tmp_path / "low.toml").write_text(IN_CONTACT)
    for make in (
        lambda: RaceEnv(track=tmp_path / "low.toml"),
        lambda: load(track=load_track(tmp_path / "low.toml")),
    ):
        with pytest.raises(ValueError, match=r"at start.position .* touches ground; move the"):
            make()


def test_a_probable_mistake_in_a_track_file_is_a_warning(tmp_path):
    path, text = (
        tmp_path / "narrow.toml",
        "[[gates]]\ncenter = [0, 0, 1.3]\nwidth = {}\nheight = 1\n",
    )
    path.write_text(text.format(0.01))
    for make in (lambda: RaceEnv(track=path), lambda: load(track=load_track(path))):
        with pytest.warns(UserWarning, match="gate 0 is 0.01 x 1 m, too small for the body"):
            make()
    path.write_text(text.format(1.0))
    RaceEnv(track=path), load(track=load_track(path))  # a warning is an error here


def test_what_acts_on_no_flight_is_a_warning_as_in_suite_eval():
    sagging = with_effects(VEHICLE, {"battery_sag": BatterySag(0.0, 0.1)})
    for make in (lambda: RaceEnv(vehicle=sagging), lambda: load(vehicle=sagging)):
        with pytest.warns(UserWarning, match="battery_sag: acts only on logs with a voltage"):
            make()


@pytest.mark.parametrize("seed", [(1, 2), np.array([1, 2]), [1, 2]])
def test_any_sequence_of_seeds_is_taken(seed):
    env = RaceVectorEnv(2)
    assert env.reset(seed=seed)[1]["track_seed"].tolist() == (
        env.reset(seed=np.int64(1))[1]["track_seed"].tolist()
    )


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda env: env.reset(seed=[1, 2, 3]), r"seed is \[1, 2, 3\], .* num_envs = 2"),
        (lambda env: env.reset(seed=1.5), "seed is 1.5, allowed is a whole number"),
        (lambda env: env.reset(options={"trackseed": 5}), "Did you mean 'track_seed'"),
        (lambda env: env.reset(options={"track_seed": 5.7}), "track_seed is 5.7, allowed is a"),
        (lambda env: type(env)(track_seed=5.7), "track_seed is 5.7, allowed is a whole number"),
        (lambda env: env.reset(options={"track_seed": 2**32}), "is 4294967296, allowed is a whole"),
        (lambda env: type(env)(track_seed=2**70), "allowed is a whole number from 0 to 4294967295"),
        (lambda env: type(env)(render_mode="rgb_array"), "render_mode is 'rgb_array', .* None"),
        (lambda env: RaceEnv(render_mode="human"), "'human', allowed is None or 'rgb_array'"),
        (
            lambda env: RaceEnv(render_mode=BAD_MODE),
            r"render_mode is \['human'\], allowed is None",
        ),
        (
            lambda env: type(env)(render_mode=np.arange(2)),
            r"render_mode is array.*, allowed is None",
        ),
        (lambda env: suite.make_env(render_mode=3), "render_mode is 3, allowed is None or 'rgb_"),
        (lambda env: env.reset(options=3), "options is 3, allowed is a dict or None"),
        (lambda env: RaceEnv().reset(options={"track_sed": 5}), "Did you mean 'track_seed'"),
    ],
)
def test_seeds_options_and_render_modes_are_checked(call, said):
    with pytest.raises(ValueError, match=said):
        call(RaceVectorEnv(2))


@pytest.mark.parametrize("action", [np.zeros(4), 0.0, None, "abc", [[0.0, 0.0]]])
def test_gymnasium_refuses_an_action_of_another_shape(action):
    for env in (RaceEnv(), RaceVectorEnv(2)):
        env.reset()
        with pytest.raises(ValueError, match=r"^action (has shape .*see env.action|is .*numbers)"):
            env.step(action)
