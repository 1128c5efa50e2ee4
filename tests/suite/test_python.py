"""The Python interface: its calls keep inputs, refuse what commands refuse, and warn as they do."""

import shutil
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

import suite
from eval.worlds import WORLDS
from eval.worlds.scene_slots import SceneSlots
from policies.shipped import locate
from suite.common.running.lock import one_writer
from suite.diagnose import example
from tests.support.courses import ONE_GATE
from tests.support.pilots import Pursuit
from tests.support.tools import python
from tracks.families import FAMILIES, make_track
from tracks.families.layout import Layout

EXAMPLE = Path(example.__file__).parent
"""Folder of the example's flights and its vehicle file."""
PROGRAM = """
import suite
from tests.support.pilots import Pursuit

if __name__ == "__main__":
    class Pilot(Pursuit):
        pass

    suite.evaluate_policy(Pilot(), track="zigzag", trials=2, workers=2)
"""
"""A program whose policy other processes lack."""


@pytest.fixture
def identify(tmp_path):
    """Return a call that identifies a copy of the example's vehicle from copies of its flights."""
    for path in (*EXAMPLE.glob("*.parquet"), EXAMPLE / "vehicle.toml"):
        shutil.copy(path, tmp_path)
    flights = sorted(tmp_path.glob("*.parquet"))
    return partial(suite.identify_vehicle, flights, tmp_path / "vehicle.toml")


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("vehicle.toml", "out: .*vehicle.toml is also an input .*; give another out$"),
        ("flight_1.parquet", "out is .*flight_1.parquet'; its ending must be .toml$"),
    ],
)
def test_an_identification_overwrites_neither_its_vehicle_nor_a_log(identify, tmp_path, out, said):
    before = (tmp_path / out).read_bytes()
    with pytest.raises(ValueError, match=said):
        identify(tmp_path / out)
    assert (tmp_path / out).read_bytes() == before


def test_an_identified_file_says_from_how_many_flights_it_is(identify, tmp_path):
    identify(tmp_path / "mine.toml", progress=False)
    assert "by suite identify, 3 flights (rates)" in (tmp_path / "mine.toml").read_text()


def test_faults_are_accepted_by_name_and_the_warnings_of_an_identification_printed(
    tmp_path, monkeypatch, capsys
):
    given = []

    def stop(*args):
        given.append(args)
        raise ValueError("correct it, or continue anyway with --accept rate_sign")

    monkeypatch.setattr("suite.diagnose.run.diagnose_files", stop)
    for accept in ("rate_sign", ["rate_sign"]):
        with pytest.raises(ValueError, match=r"anyway with accept rate_sign$"):
            suite.diagnose_flights("none", "racer5", tmp_path / "out", accept=accept)
    assert [config.accept for config, _ in given] == [("rate_sign",)] * 2
    assert not (tmp_path / "out").exists()

    name = "suite.diagnose.identify.run.identify_files"
    monkeypatch.setattr(name, lambda *args: given.append(args) or {"warnings": ["a doubt"]})
    suite.identify_vehicle("none", "racer5", tmp_path / "v.toml", accept="rate_sign")
    assert given[-1][-1] == ("rate_sign",)
    assert "warning: a doubt" in capsys.readouterr().err


def test_a_folder_in_which_another_program_writes_or_that_is_a_file_is_refused_before_the_work(
    tmp_path, monkeypatch
):
    for work in ("suite.diagnose.run.diagnose_files", "suite.train.run.train"):
        monkeypatch.setattr(work, lambda *_: pytest.fail("the work began"))
    (tmp_path / "file").write_text("kept")
    calls = (
        lambda out: suite.diagnose_flights([EXAMPLE], "racer5", out),
        lambda out: suite.train_policy(out, "quick"),
    )
    with one_writer(tmp_path / "locked"):
        for call in calls:
            with pytest.raises(ValueError, match="is being written by .* or give another out$"):
                call(tmp_path / "locked")
            with pytest.raises(FileExistsError, match="file"):
                call(tmp_path / "file")


def test_a_training_warns_as_the_command_does_and_names_arguments(tmp_path, monkeypatch):
    outcome = SimpleNamespace(policy=str(tmp_path))
    monkeypatch.setattr("suite.train.run.train", lambda *_: outcome)
    train = partial(suite.train_policy, tmp_path / "run", "quick")
    with pytest.warns(UserWarning, match="spec.camera.fov_deg is in degrees"):
        train(settings="spec.camera.fov_deg=(1.4,1.1)")
    for call, said in (
        (partial(train, seed=None), "seed is None, allowed is a whole number"),
        (partial(train, iterations=0), "iterations is 0, allowed is 1 to"),
        (partial(suite.evaluate_policy, seed=None), "seed is None, allowed is a whole number"),
        (partial(suite.evaluate_policy, trials=None), "trials is None, allowed is a whole number"),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            call()
    with pytest.raises(ValueError, match="^out .* is the folder of a policy"):
        suite.train_policy(locate("race-small"), "quick")


def test_a_training_does_not_depend_on_the_precision_that_a_program_chose_in_jax(tmp_path):
    settings = ("episode.batch=2", "episode.steps=2", "optimizer.warmup=1")
    train = partial(suite.train_policy, settings=settings, iterations=2, progress=False)
    weights = [train(tmp_path / "plain", "quick") / "weights.safetensors"]
    jax.config.update("jax_enable_x64", True)  # for all threads
    try:
        weights.append(train(tmp_path / "x64", "quick") / "weights.safetensors")
        assert jax.config.jax_enable_x64
    finally:
        jax.config.update("jax_enable_x64", False)
    assert weights[0].read_bytes() == weights[1].read_bytes()


def test_a_track_of_a_family_has_a_name_of_its_own_and_equal_flights_count_as_one():
    track, pilot = suite.make_track("zigzag", 3, 5), Pursuit()
    fly = partial(suite.evaluate_policy, track=track)
    with pytest.warns(UserWarning, match="zigzag-3-5: 2 equal flights, .* count as one trial"):
        results = fly(pilot, trials=2)
    # By these a trial of the family would be on another track.
    assert {result.trial[:2] for result in results} == {("zigzag-3-5", 3)}
    (drawn,) = suite.evaluate_policy(pilot, track="zigzag", difficulty=3, seed=5, trials=1)
    assert results[0][6:] == drawn[6:]


def test_what_cannot_be_sent_to_other_processes_is_refused_with_what_can(tmp_path):
    fly = partial(suite.evaluate_policy, track="zigzag", difficulty=0, trials=2, workers=2)
    with pytest.raises(ValueError, match="^policy 'race-small' cannot .* give its name or path"):
        fly(suite.load_policy("race-small"))
    ended = python(PROGRAM)
    assert "ValueError: another process lacks what this program defines" in ended.stderr
    assert "Pilot" in ended.stderr and "or leave workers out" in ended.stderr
    # Other processes import a file, and without the guard its call too.
    call = 'suite.evaluate_policy("race-small", track="zigzag", trials=2, workers=2)'
    (path := tmp_path / "program.py").write_text(f"import suite\n{call}\n")
    ended = python("import runpy, sys; runpy.run_path(sys.argv[1], run_name='__main__')", path)
    assert "With exit code 1 it could not import this program: call eval" in ended.stderr


def test_what_cannot_be_used_is_not_registered(monkeypatch):
    class Incomplete(SceneSlots):
        """A simulator without `_move`."""

    with pytest.raises(ValueError, match="'incomplete': Incomplete lacks its methods _move$"):
        suite.register_simulator("incomplete", Incomplete)
    with pytest.raises(ValueError, match="'all', which means the judged families"):
        suite.register_track("all", FAMILIES["zigzag"])
    drawn = make_track("zigzag", 0, 0)
    layout = Layout(drawn.scene, drawn.start_pos_w, drawn.start_yaw, drawn.names)
    with pytest.raises(ValueError, match="Layout.* characters.; must be a function") as refused:
        suite.register_track("layout", layout)
    assert len(str(refused.value)) < 200
    for kept in ("_entries", "_values"):
        monkeypatch.setattr(FAMILIES, kept, {**getattr(FAMILIES, kept)})
    suite.register_track("own", FAMILIES["zigzag"])
    # A cell of a notebook that runs again: what was compiled and checked knows the first one.
    for name, said in (("own", "or restart the program .*kernel.$"), ("zigzag", "another name$")):
        with pytest.raises(ValueError, match=f"'{name}' exists already; .*{said}"):
            suite.register_track(name, FAMILIES["zigzag"])
    assert not {"incomplete", "all"} & {*FAMILIES, *WORLDS}


def test_lists_of_other_things_are_named_whole_and_a_path_with_a_comma_is_one_track(tmp_path):
    diagnose = partial(suite.diagnose_flights, vehicle="racer5", out=tmp_path / "out")
    for call, said in (
        (
            partial(diagnose, b"flight"),
            "flights is b'flight', allowed is a text or a path, or a se",
        ),
        (partial(diagnose, {"a": "b"}), "flights is {'a': 'b'}, allowed is"),
        (partial(diagnose, "none", accept=None), "accept is None, allowed is the name of a fault"),
        (
            partial(suite.train_policy, tmp_path, settings=""),
            "settings is '', allowed is a text su",
        ),
    ):
        with pytest.raises(ValueError, match=f"^{said}"):
            call()
    (tmp_path / "a,b").mkdir()
    (tmp_path / "a,b" / "course.toml").write_text(ONE_GATE)
    (result,) = suite.evaluate_policy(Pursuit(), track=tmp_path / "a,b" / "course.toml", trials=1)
    assert result.track == suite.load_track(tmp_path / "a,b" / "course.toml").family
