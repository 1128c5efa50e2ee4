"""The small commands, and what the options of the train command become."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import suite
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from policies import shipped
from policies.formats import policy_file
from suite.blind import make
from suite.commands.train import Config, resolve
from suite.common.vehicles import camera_warnings
from suite.delta.replay import describe_dynamics
from suite.judging.flying import checkpoint_folder
from suite.train import run as training
from suite.train.run import rate_loop_warnings
from tests.support.commands import answer, refused, run
from tests.support.documents import unpainted
from tests.support.marks import more
from tracks.geometry.camera import Camera


def test_tracks_command_lists_and_draws(tmp_path, capfd, monkeypatch):
    unpainted(monkeypatch)
    families = answer(capfd, "tracks")["families"]
    assert families["zigzag"]["judged"] and not families["random"]["judged"]
    assert run("tracks zigzag --difficulty 0,9 --seed 4 --out", tmp_path) == 0
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["zigzag-0-4.png", "zigzag-4.png", "zigzag-9-4.png"]
    assert (tmp_path / names[0]).read_bytes().startswith(b"\x89PNG")
    mine, out = tmp_path / "mine.toml", tmp_path / "out"
    gates = "[[gates]]\ncenter = [{}, 0, 2]\nwidth = {}\nheight = 0.12\n"
    mine.write_text(f'name = "a/b c"\n{gates.format(3, 25)}{gates.format(6, 0.1)}')
    assert run("tracks --difficulty 5 --out", out, mine) == 0
    assert [path.name for path in out.iterdir()] == ["mine-0-0.png"]
    said = " ".join(capfd.readouterr().err.split())
    assert "has no levels, so --difficulty" in said and "its largest gate is 25 m wide" in said
    assert "gate 1 is 0.1 x 0.12 m, too small for the body of 'racer5'" in said
    for command in ("eval", "tracks zigzag", "export"):
        said = refused(capfd, f"{command} --out", mine)
        assert f"a file exists: {mine}; give another --out" in said
    assert "--speed is 2.0, allowed is 0 to 1" in refused(capfd, "eval --speed 2")


@pytest.mark.parametrize("workers", [1, more(2)])
def test_doubts_about_a_vehicle_file_are_printed_once_and_stop_nothing(workers, tmp_path, capfd):
    """Two processes could each say them again."""
    vehicle = load_vehicle("reference")
    arms = tuple(tuple(1000.0 * x for x in hub) for hub in vehicle.rotors.position)
    save_vehicle(
        replace(vehicle, rotors=replace(vehicle.rotors, position=arms)), tmp_path / "mm.toml"
    )
    command = "eval --track zigzag --difficulty 0 --trials 2 --time-limit-s 0.1 --workers"
    for name, count in ((tmp_path / "mm.toml", 1), ("reference", 0)):
        out = tmp_path / f"out{count}"
        assert run(f"{command} {workers} --out", out, "--vehicle", name) == 0
        assert capfd.readouterr().err.count("divide by 1000") == count
    train = "train --model quad --list-settings --vehicle"
    assert run(train, tmp_path / "mm.toml") == 0
    assert capfd.readouterr().err.count("divide by 1000") == 1
    page = "reproduce robustness --policy no.onnx --out"
    assert "divide by 1000" in refused(capfd, page, tmp_path, "--vehicle", tmp_path / "mm.toml")


def test_a_policy_with_another_camera_than_the_vehicle_file_gives_a_warning(tmp_path, capfd):
    vehicle, tilted = load_vehicle("racer5"), tmp_path / "tilted.toml"
    save_vehicle(replace(vehicle, camera=Camera(pitch_deg=35.0)), tilted)
    flights = "eval --track zigzag --difficulty 0 --trials 1 --time-limit-s 0.1 --out"
    assert run(flights, tmp_path / "out", "--vehicle", tilted) == 0
    assert "deg, pitched up by 35 deg; simulated images are" in capfd.readouterr().err
    training = "train --init-from nosuch --vehicle"
    told = refused(capfd, training, tilted, "--out", tmp_path / "run")
    advice = "give --set spec.camera.pitch_deg=35 spec.camera.fov_deg=78.4,63.8"
    assert f"{advice} and leave --init-from out" in told, "a start has one camera"
    same = "--set", "spec.camera.pitch_deg=35", "--out", tmp_path / "run"
    assert "spec.camera.fov_deg" not in refused(capfd, training, tilted, *same)
    # A vehicle file without a camera says nothing about it.
    assert camera_warnings(Camera(pitch_deg=35.0), vehicle) == []


def test_effects_command_lists_and_describes(capfd):
    effects = answer(capfd, "effects")["effects"]
    assert effects["linear_drag"]["parameters"]["coefficient"]["unit"] == "1/s"
    assert run("effects linear_drag") == 0
    assert "coefficient x 3 [1/s]" in capfd.readouterr().out
    # A scale varies about 1; a length has no neutral value to vary about.
    assert run("effects thrust_scale") == 0
    assert "usually 0.05 to 0.15 away from 1;" in capfd.readouterr().out
    for effect, usual in (("gusts", "2 to 10"), ("slung_load", "0.3 to 1")):
        assert run(f"effects {effect}") == 0
        assert f"length [m]: usually {usual}; allowed" in capfd.readouterr().out
        assert effects[effect]["parameters"]["length"]["typical_is"] == "a value"
    scale = effects["thrust_scale"]["parameters"]["scale"]
    assert scale["typical_is"] == "a difference from neutral"
    assert "Did you mean 'linear_drag'?" in refused(capfd, "effects linear_darg")


def test_the_command_says_which_flights_separate(capsys):
    flights = answer(capsys, "blind plan --effects linear_drag rotor_drag")["flights"]
    assert {flight["kind"] for flight in flights} == {"punches", "figure_eight"}
    for names in ("", "--effects inflow inflow"):
        assert "two different names" in refused(capsys, f"blind plan {names}")
    for work in ("run", "score"):
        assert "make the set first" in refused(capsys, f"blind {work} --out /no/such/set")


def test_an_option_of_another_work_is_refused(tmp_path, monkeypatch, capsys):
    """Taken in silence it would be believed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(make, "make_set", None)
    for args, words in (
        ("run --set published", "--set is published, but `suite blind run` does not take it, only"),
        ("score --seed 0", "--seed is 0, but `suite blind score` does not take it, only make;"),
        ("run --count 24", "--count is 24, but"),
        ("score --simulator rotorpy", "--simulator is rotorpy, but"),
        ("run --effects inflow gusts", "--effects is inflow gusts, but"),
        ("make --set published --seed 3", "--set is published, but --seed 3 makes another set;"),
        ("make --effects inflow", "does not take it, only plan; leave it out"),
        ("score --workers 2", "--workers is 2, but `suite blind score` does not take it, "),
        ("plan --effects inflow gusts --out elsewhere", "--out is elsewhere, but"),
    ):
        assert words in refused(capsys, f"blind {args}")
    for command, words in (
        ("list policies --recipe quick", "--recipe is quick, but only `suite list settings`"),
        ("check --vehicle racer5 --trials 9", "--trials is 9, but no --policy is given; leave it"),
        ("view race --pick failed", "--pick is failed, but race is not a finished run of suite ev"),
    ):
        assert words in refused(capsys, command)
    assert not list(tmp_path.iterdir())


def test_train_lists_the_settings_of_its_recipe_and_trains_nothing(tmp_path, capfd, monkeypatch):
    monkeypatch.setattr(training, "train", None)
    found = answer(capfd, "train --recipe quick --list-settings --out", tmp_path / "run")[
        "settings"
    ]
    paths = [setting["path"] for setting in found]
    assert {"optimizer.rate", "loss.progress", "spec.camera.width"} <= set(paths)
    assert "seed" not in paths, "--seed sets it"
    assert all(setting["about"] for setting in found) and not list(tmp_path.iterdir())


def test_options_become_settings():
    config = resolve(Config(recipe="quick", seed=4, iterations=7, set=("optimizer.rate=1",)))
    assert (config.seed, config.optimizer.iterations, config.optimizer.rate) == (4, 7, 1.0)
    with pytest.raises(ValueError, match="Did you mean 'race'"):
        resolve(Config(recipe="rcaer"))


def test_listed_settings_are_those_of_the_other_options(capsys):
    asked = "train --list-settings --finetune --init-from race --sensors vio --set loss.tilt=3"
    listed = {one["path"]: one["default"] for one in answer(capsys, asked)["settings"]}
    assert (listed["spec.rate_hz"], listed["loss.tilt"]) == (30.0, 3.0)
    assert listed["sensors.perfect_share"] == 0.1


def test_sensors_that_change_nothing_in_a_training_are_refused(tmp_path):
    file = tmp_path / "mine.toml"
    for model in ('[[imu]]\nkind = "imu"\ngyro_bias = 0.01\n', '[depth]\nkind = "tof"\n'):
        file.write_text(f'schema = 1\nname = "mine"\n{model}')
        with pytest.raises(ValueError, match=r"(imu|tof) does not change what a policy sees"):
            resolve(Config(sensors=str(file)))
    file.write_text('schema = 1\nname = "mine"\n')
    with pytest.raises(ValueError, match="the file has no sensor model"):
        resolve(Config(sensors=str(file)))


def test_training_goes_on_from_a_policy_by_its_name_and_does_not_write_over_it(
    tmp_path, capsys, monkeypatch
):
    assert checkpoint_folder("race-paper", "--init-from") == shipped.locate("race-paper")
    said = refused(capsys, "train --init-from rac --out", tmp_path / "run")
    assert "unknown --init-from 'rac'. Did you mean 'race'?" in said
    trained = tmp_path / "trained"
    shutil.copytree(shipped.locate("race-paper"), trained / "policy")
    said = refused(capsys, "train --init-from", trained, "--out", tmp_path / "run")
    assert f"is the folder of a training; give its policy, {trained / 'policy'}" in said
    said = refused(capsys, "eval --policy race --out", trained / "policy" / "eval")
    assert "policy/eval is in the folder of a policy" in said
    said = refused(capsys, "train --delta", trained, "--out", tmp_path / "run")
    assert "--delta needs the --out of suite delta" in said
    assert not (tmp_path / "run").exists()
    rates = []
    monkeypatch.setattr(training, "start_params", lambda _, spec: rates.append(spec.rate_hz))
    monkeypatch.setattr(training, "train", None)
    first = "phases.1.spec.rate_hz=20"
    run(f"train --init-from race --set {first} --out", tmp_path / "run")
    assert rates == [20.0], "of the first phase"
    assert "will have" not in capsys.readouterr().err
    # The default recipe would give this policy more inputs, and train it through a quadrotor.
    run("train --init-from race-paper --out", tmp_path / "run")
    said = capsys.readouterr().err
    assert "will have the inputs and the rate of the recipe race" in said
    assert "second_gate is False there, True here" in said
    own = shutil.copytree(shipped.locate("race-paper"), tmp_path / "policy")
    said = refused(capsys, "train --out", tmp_path, "--init-from", own)
    assert "config.json is also an input and would be overwritten" in said
    said = refused(capsys, "train --init-from race-paper --out", own)
    assert "is the folder of a policy; give a folder for the new run" in said
    changes = "--set spec.camera.fov_deg=1.4,1.1 loss.tilt=1"
    run(f"train --recipe race-paper --iterations 20 {changes} --out", tmp_path / "run")
    said = capsys.readouterr().err
    assert "20 gradient steps, not more than the warm-up" in said
    assert "sees only 1.4 x 1.1 deg" in said and "loss.tilt has no gradient" in said
    assert "optimizer.rate" in refused(capsys, "train --set optimizer.rate=0 --out", tmp_path / "r")


def test_a_delta_action_model_has_the_rate_of_every_phase(tmp_path, capsys, monkeypatch):
    dynamics = resolve(Config()).quadrotor
    assert dynamics is not None
    config = {"fit": {"rate_hz": 15.0, **describe_dynamics(dynamics)}}
    stored = SimpleNamespace(config=config, params={}, arrays={})
    monkeypatch.setattr(policy_file, "load_delta", lambda folder: stored)
    monkeypatch.setattr(training, "train", None)
    said = refused(capsys, "train --delta", tmp_path, "--out", tmp_path / "run")
    assert "with 15 decisions a second, and this run has 30" in said


def test_the_command_line_asks_for_model_and_vehicle_together():
    reference = load_vehicle("reference")
    config = resolve(Config(model="quad", vehicle="reference"))
    assert config.quadrotor is not None and config.quadrotor.vehicle == reference
    changed = resolve(Config(model="quad", vehicle="racer5", set=("quadrotor.physics_hz=500",)))
    assert changed.quadrotor is not None and changed.quadrotor.physics_hz == 500.0
    own = resolve(Config()).quadrotor
    assert own is not None and own.vehicle != reference, "by default it has not seen the tables'"
    assert resolve(Config(recipe="race-paper")).quadrotor is None
    assert resolve(Config(model="quad")) == resolve(Config()), "the recipe's vehicle"
    with pytest.raises(ValueError, match="--model quad needs --vehicle.*add --vehicle racer5"):
        resolve(Config(recipe="quick", model="quad"))
    around = resolve(Config(vehicle="reference")).quadrotor
    assert around == replace(own, vehicle=reference), "the recipe's own spreads"
    with pytest.raises(ValueError, match="--vehicle is racer5.*point mass has none.*--model quad"):
        resolve(Config(recipe="race-paper", vehicle="racer5"))
    with pytest.raises(ValueError, match="Did you mean 'racer5'"):
        resolve(Config(model="quad", vehicle="racer6"))


def test_a_rate_loop_faster_than_the_physics_of_the_training_gives_a_warning(tmp_path):
    nominal = load_vehicle("racer5")
    fast = replace(nominal, controller=replace(nominal.controller, rate_gain=(200.0, 20.0, 8.0)))
    save_vehicle(fast, tmp_path / "fast.toml")
    (warning,) = rate_loop_warnings(resolve(Config(vehicle=str(tmp_path / "fast.toml"))))
    assert "rate_gain has 200 1/s" in warning and "quadrotor.physics_hz=500" in warning
    slow = [Config(), Config(recipe="quick")]
    slow.append(Config(vehicle=str(tmp_path / "fast.toml"), set=("quadrotor.physics_hz=500",)))
    assert all(rate_loop_warnings(resolve(config)) == [] for config in slow)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("track", ["zigzag"], "a text, a path or a Track"),
        ("vehicle", {}, "a name, a path or a Vehicle"),
        ("trials", 1.5, "a whole number, 1 to"),
        ("seed", "1", "a whole number, 0 to"),
        ("workers", "2", "a whole number, 1 to 256"),
        ("difficulty", [0, 3], "a level, or several as a text"),
        ("sensors", None, "a name or a path"),
    ],
)
def test_from_python_an_argument_of_another_type_is_refused(name, value, allowed):
    with pytest.raises(ValueError, match=re.escape(f"{name} is {value!r}, allowed is {allowed}")):
        suite.evaluate_policy("race-paper", **{name: value})


WRONG: tuple[Any, ...] = (3, None, ["race"], {}, b"race", np.arange(3))
CALLS: dict[str, Callable[[Any], Any]] = {
    "flights": lambda given: suite.diagnose_flights([given], "reference", "out"),
    "out": suite.train_policy,
    "recipe": lambda given: suite.train_policy("out", given),
    "policy": suite.load_policy,
    "trust": lambda given: suite.load_policy("race", trust=given),
    "path": suite.load_track,
    "path ": suite.read_flight,
    "path  ": lambda given: suite.write_flight(given, None),  # type: ignore[arg-type]
    "path   ": lambda given: suite.save_vehicle(suite.load_vehicle("racer5"), given),
    "log": lambda given: suite.write_flight("it.csv", given),
    "vehicle": suite.load_vehicle,
    "vehicle ": lambda given: suite.save_vehicle(given, "it.toml"),
    "comment": lambda given: suite.save_vehicle(suite.load_vehicle("racer5"), "it.toml", given),
    "simulator": lambda given: suite.evaluate_policy(simulator=given, trials=1),
    "track family": lambda given: suite.make_track(given, 0, 0),
    "level": lambda given: suite.make_track("zigzag", given, 0),
    "seed": lambda given: suite.make_track("zigzag", 0, given),
    "effect": suite.register_effect,
    "track family (register)": lambda given: suite.register_track(given, print),
    "simulator (register)": lambda given: suite.register_simulator(given, object),
}
"""Name of an argument in the message -> the call that takes it."""


@pytest.mark.parametrize("name", CALLS)
def test_what_a_function_cannot_load_is_refused_with_what_is_allowed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for given in WRONG:
        if name in ("level", "seed") and isinstance(given, int):
            continue
        said = f"{name.strip()} is {given!r}, allowed is "
        with pytest.raises(ValueError, match=f"^{re.escape(said)}"):
            CALLS[name](given)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("tracks --difficulty 3", "--difficulty, --seed and --out are for a picture"),
        ("tracks --out pictures", "such as suite tracks zigzag"),
        ("tracks all", "TRACK is 'all', allowed is one of zigzag, circular, ellipse, random, or"),
        ("view raec", "unknown RUN 'raec'. Did you mean 'race'?"),
        (
            "view nothere",
            "The --out folder of a suite eval, a checkpoint's folder or a policy file",
        ),
    ],
)
def test_names_and_options_without_effect_are_refused_with_what_is_allowed(
    line, words, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert words in refused(capsys, line)
    assert not list(tmp_path.iterdir())
