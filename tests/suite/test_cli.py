"""The command line's manners: fast help, exit codes, one clear message, clean JSON."""

import dataclasses
import errno
import json
import os
import re
import signal
import sys
import types
import weakref
from dataclasses import dataclass

import pytest

from suite import cli
from suite.common.options import Command, options
from tests.support.commands import refused
from tracks.common.provenance import VERSION


@dataclass(frozen=True)
class Config(Command):
    """A command for these tests."""

    fault: str = ""
    """What goes wrong."""
    seed: int = 0
    """A number."""


def _run(config, console):
    console.say("for people")
    os.write(1, b"from a native library\n")
    match config.fault:
        case "bug":
            int("three")
        case "full":
            raise OSError(errno.ENOSPC, "No space left on device", "runs/x")
        case "missing":
            open("/no/such/file")
        case "ctrl-c":
            os.kill(os.getpid(), signal.SIGINT)
        case "kill":
            os.kill(os.getpid(), signal.SIGTERM)
        case "memory":
            raise MemoryError
    return {"seed": config.seed, "nan": float("nan")}


@pytest.fixture
def command(monkeypatch):
    """Add `suite probe`, whose module is this file's Config and _run."""
    module = types.ModuleType("suite.commands.probe")
    module.Config, module.run = Config, _run  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "suite.commands.probe", module)
    monkeypatch.setitem(cli.COMMANDS, "probe", "for tests")
    # A shell that starts the tests in the background has them ignore Ctrl-C.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def test_the_page_of_commands_lists_every_one(root):
    page = (root / "docs/reference/commands.md").read_text()
    listed = re.findall(r"^### suite (\w+)$", page, re.MULTILINE)
    assert sorted(listed) == sorted(cli.COMMANDS)


def test_every_command_has_help_for_every_option_and_no_flag_is_on_by_default(capsys):
    for name in cli.COMMANDS:
        assert cli.main([name, "--help"]) == 0
        text = capsys.readouterr().out
        assert f"suite {name}" in text and "--json" in text
        kind = sys.modules[f"suite.commands.{name}"].Config
        assert kind.__dataclass_params__.frozen
        assert text.index("Examples:\n  suite ") < text.index("--help ") and "None" not in text
        for option in options(kind):
            assert option.about and (option.positional or option.flag in text), option
            # By this name `suite.common.vehicles` finds the files to warn of.
            is_file = "vehicle file" in option.about.partition(".")[0]
            assert not is_file or option.field.endswith("vehicle"), option
        notes = text.partition("\nNotes:\n")[2].partition("╭")[0]
        assert max(map(len, notes.splitlines()), default=0) <= 80
        rare = [option.flag for option in options(kind) if option.advanced]
        assert all(flag in text.partition("advanced options")[2] for flag in rare)
        on = [field.name for field in dataclasses.fields(kind) if field.default is True]
        assert not on, f"suite {name}: call it no_{on[0]}, with a text for what it then does not do"


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", "info"),
        ("inof", "Did you mean 'info'?"),
        ("probe --sede 3", "--seed"),
        ("--json eval", "options come after a command: suite eval --json"),
        ("bench nothing", "unknown benchmark 'nothing'"),
        ("eval --trials ten", "'ten' is not a whole number"),
        ("train --iterations 1.5", "'1.5' is not a whole number"),
        ("train --lr high", "'high' is not a number"),
        ("eval runs/one", "'runs/one' belongs to no option; suite eval --help"),
    ],
)
def test_a_wrong_command_or_option_is_code_2(command, capsys, line, words):
    assert cli.main(line.split()) == 2
    said = capsys.readouterr()
    assert said.out == "" and words in said.err and "Traceback" not in said.err


@pytest.mark.parametrize("words", [("--out", ""), ("--out=",), ("", "--vehicle", "racer5")])
def test_an_empty_word_is_not_the_current_folder(words, capsys):
    said = refused(capsys, "eval" if words[0] else "diagnose", *words)
    assert words[0] in said and "a variable of the shell" in said


def test_a_list_may_have_commas_or_spaces_and_some_options_may_be_given_again():
    for line, track, levels in (
        ("--track zigzag circular", "zigzag,circular", "0,3"),
        ("--track zigzag,circular --seed 3", "zigzag,circular", "0,3"),
        ("--difficulty=0 3 --track all", "all", "0,3"),
        ("--seed 3 --difficulty 0 3,9", "all", "0,3,9"),
        ("--difficulty 0-2 5 --seed 3", "all", "0-2,5"),
    ):
        flown = cli.parse("eval", line.split())[1].flown
        assert (flown.track, flown.difficulty) == (track, levels)
    assert cli.parse("eval", ["--speed", "0.3,1"])[1].flown.speed == (0.3, 1.0)
    assert cli.parse("export", ["--format=c,onnx"])[1].formats == ("c", "onnx")
    config = cli.parse("reproduce", "simulators --simulator mjx --simulator rotorpy".split())[1]
    assert config.experiment.simulator == ("mjx", "rotorpy")
    for line in ("--out gpu table2 --trials 2", "--cache=a table2 --trials 2 --out gpu"):
        config = cli.parse("reproduce", line.split())[1]
        assert (str(config.out), config.experiment.trials) == ("gpu", 2)
    # As a shell expands runs/seed*/policy.
    for line in ("--policy a --policy b", "--policy a b --seed 3"):
        assert cli.parse("eval", line.split())[1].flown.policies == ("a", "b")
    # A comma within a value is no list's.
    training = cli.parse("train", ["--set", "spec.camera.fov_deg=87,58", "loss.progress=2"])[1]
    assert training.set == ("spec.camera.fov_deg=87,58", "loss.progress=2")
    line = "a,b.parquet --vehicle x --reference c,d.parquet --relevance 0,0,0"
    config = cli.parse("diagnose", line.split())[1]
    assert list(map(str, config.flights + config.reference)) == ["a,b.parquet", "c,d.parquet"]
    assert config.relevance == (0.0, 0.0, 0.0)


def test_a_word_behind_a_list_may_be_a_positional_one():
    _, config = cli.parse("tracks", ["--difficulty", "9", "ellipse"])
    assert (config.difficulty, config.track) == ("9", "ellipse")


def test_json_is_one_object_on_standard_output_and_nothing_else(command, capfd):
    assert cli.main(["probe", "--json", "--seed", "5"]) == 0
    said = capfd.readouterr()
    assert json.loads(said.out) == {"seed": 5, "nan": None}
    assert "for people" in said.err and "native library" in said.err
    assert cli.main(["probe"]) == 0
    assert capfd.readouterr().out.startswith("for people")


@pytest.mark.parametrize(
    ("fault", "code", "words"),
    [
        ("full", 1, "the disk is full: runs/x; free some space"),
        ("missing", 2, "no such file or directory: /no/such/file"),
        ("memory", 1, "out of memory"),
        ("ctrl-c", 130, "interrupted; the same command continues"),
        ("kill", 130, "interrupted; the same command continues"),
    ],
)
def test_what_a_person_may_meet_is_one_line(command, capsys, fault, code, words):
    assert cli.main(["probe", "--fault", fault]) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and words in lines[0]


def test_what_an_interrupted_command_held_is_not_freed_before_the_process_ends(
    command, monkeypatch, capsys
):
    """XLA's threads may still use it."""
    monkeypatch.setattr(sys, "last_value", None, raising=False)
    freed = []

    def run(config, console):
        held = {"it"}
        weakref.finalize(held, freed.append, "it")
        raise KeyboardInterrupt

    monkeypatch.setattr(sys.modules["suite.commands.probe"], "run", run)
    assert cli.main(["probe"]) == 130 and not freed
    sys.last_value = None
    assert freed == ["it"]


def test_a_bug_keeps_its_traceback(command, capsys):
    assert cli.main(["probe", "--fault", "bug"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_info_says_versions_devices_and_machine(capfd):
    assert cli.main(["info", "--json"]) == 0
    facts = json.loads(capfd.readouterr().out)
    assert facts["suite"] == VERSION
    assert facts["packages"]["mujoco"].startswith("3.")
    assert facts["jax_devices"] and facts["machine"]["cores"] >= 1


HUGE = "9" * 400
SETTINGS = """
    spec.rate_hz=0.0 spec.rate_hz=1000 spec.hidden_size=0 spec.hidden_size=10000000
    spec.camera.width=33 spec.camera.width=0 spec.camera.rays=0 spec.camera.range_m=0.2
    spec.channels=(16,32,33) spec.channels=(0,32,32) physics.drag=(2.0,1.0) physics.lag_mean=-5
    optimizer.rate=nan optimizer.rate=-1 optimizer.memory=1.0 loss.progress=1e400
    episode.shards=-1 episode.shards=0 episode.batch=10000000000
"""
LINES = """
    eval --workers 0
    eval --deadline-s nan
    eval --deadline-s 0
    eval --deadline-s 1e400
    eval --trials 1000000000000000000
    eval --trials 0
    eval --trials 1 --trials 2
    eval --seed 9223372036854775808
    collect --seed 9223372036854775808
    view race-paper --count 0
    tracks zigzag --seed -1
    import nothing.csv --rate nan
    import nothing.csv --full-thrust 1e400
    import nothing.csv --motor-poles 0
    delta nothing --held-out 1
    delta nothing --iterations -3
    diagnose nothing --vehicle reference --seed -1
    blind make --count -1
    loop --trials 1000000000000000000
    bench train --policy race
    bench --policy race
    reproduce table2 --trials 0
    reproduce schemes --seconds nan
    export --policy race --policy race-paper
    train --set spec.camera.width=1000 spec.camera.height=1000
    train --set spec.camera.width=320 spec.camera.height=240 spec.camera.rays=3
    train --set episode.shards=1 --set seed=2
"""
LONG = (
    *(f"eval --seed {HUGE}", f"tracks zigzag --seed {HUGE}", f"train --iterations {HUGE}"),
    *(f"train --set loss.progress={HUGE}", f"train --set seed={HUGE}"),
    *(f"train --set episode.steps={'(' * 300}", f"train --set {'x' * 5000}"),
    f"train --set loss.progress={'[' * 5000}",
)
REFUSED = (
    *(line.strip() for line in LINES.strip().splitlines()),
    *(f"train --set {setting}" for setting in SETTINGS.split()),
    *LONG,
)


@pytest.mark.parametrize("line", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_line(line, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    said = refused(capsys, line)
    settings = re.findall(r"(\w+)=", line)
    name = settings[-1] if settings else re.findall(r"--[\w-]+", line)[-1]
    assert name in said or "given twice" in said
    assert not list(tmp_path.iterdir())


def test_what_other_commands_take_by_name_is_listed(capfd):
    assert cli.main(["list", "--json"]) == 0
    found = json.loads(capfd.readouterr().out)
    assert {"race", "race-small"} <= set(found["policies"]) and "vio" in found["sensors"]
    for kind in found:
        assert cli.main(["list", kind, "--json"]) == 0
        abouts = json.loads(capfd.readouterr().out)[kind]
        assert sorted(abouts) == found[kind] and all(abouts.values())
        assert not any(text.startswith("Return") for text in abouts.values())
    assert cli.main(["list", "trakcs"]) == 2
    assert "Did you mean 'tracks'" in capfd.readouterr().err


def test_a_shell_is_given_every_command_with_its_options(capsys):
    assert cli.main(["completion", "bash"]) == 0
    cases = [line for line in capsys.readouterr().out.splitlines() if ") options=" in line]
    lines = {line.split(")")[0].strip(): line for line in cases}
    assert set(lines) == set(cli.COMMANDS)
    assert "--simulator" in lines["eval"] and "--no-delta" in lines["loop"]
