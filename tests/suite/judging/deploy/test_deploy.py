"""Exports in C with their cards: what is written, how near it is, and how it is timed."""

import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from policies.formats.c.arrays import multiply_adds
from policies.formats.c.c_file import load_c
from policies.formats.c.compiler import find_compiler
from policies.formats.c.project import random_observations
from policies.formats.export import export_policy
from policies.formats.policy_file import load_policy_checkpoint, save_policy
from policies.policy import load_policy
from policies.spec import ActionSpec, PolicySpec
from suite.judging.deploy import exporting, latency, parity
from suite.judging.flying import default_policy
from tests.support.commands import answer, refused, run
from tests.support.marks import more
from tests.support.pilots import Steady
from tests.support.policy_files import SPEC, lively, small_checkpoint

needs_cc = pytest.mark.skipif(find_compiler() is None, reason="no C compiler: cc, or what CC names")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return small_checkpoint(tmp_path_factory.mktemp("policy"))


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path_factory):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))


@needs_cc
def test_the_command_writes_c_and_a_card_that_says_how_near_it_is(folder, tmp_path, capsys):
    found = answer(capsys, "export --format c --policy", folder, "--out", tmp_path)
    assert found["parity"]["steps"] == 1000 and found["parity"]["worst"] <= 1e-4
    names = {"policy.h", "policy.c", "vectors.h", "main.c", "CMakeLists.txt", exporting.CARD}
    assert {path.name for path in tmp_path.iterdir()} == {*names, exporting.NOTE}
    text = (tmp_path / exporting.CARD).read_text()
    digest = json.loads((folder / "config.json").read_text())["weights"]["sha256"]
    for said in ("| policy | tiny |", digest, "| licence | Apache-2.0", "Success rate: unknown"):
        assert said in text


def test_a_card_of_an_earlier_export_does_not_stay(folder, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    command = f"export --format c --out {tmp_path} --policy"
    assert run(command, folder) == 0 and (tmp_path / exporting.CARD).exists()
    monkeypatch.setenv("CC", "gcc '")
    assert run(command, folder) == 2 and not (tmp_path / exporting.CARD).exists()


def test_of_an_export_to_a_full_disk_nothing_stays(folder, tmp_path, monkeypatch, capsys):
    command = f"export --format onnx c --out {tmp_path} --policy {folder}"
    monkeypatch.setenv("CC", "no-such-compiler")
    assert run(command) == 0
    for path in tmp_path.iterdir():
        if path.name != exporting.NOTE:
            path.write_text("earlier")
    write, written = Path.write_bytes, []

    def fill(path, data):
        written.append(path.name)
        if path.name == "vectors.h":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(path, data)

    monkeypatch.setattr(Path, "write_bytes", fill)
    assert run(command) == 1 and len(written) > 2
    assert f"the disk is full: {tmp_path}/vectors.h" in capsys.readouterr().err
    files = [path for path in tmp_path.iterdir() if path.name != exporting.NOTE]
    assert len(files) == 7 and {path.read_text() for path in files} == {"earlier"}


@needs_cc
@pytest.mark.extended
def test_int8_is_scaled_by_flights(folder, tmp_path, monkeypatch, capsys):
    observed = random_observations(load_policy_checkpoint(folder).spec, 30, seed=3)
    monkeypatch.setattr(exporting, "observed_flights", lambda policy: observed)
    assert run("export --format c --dtype int8 --out", tmp_path, "--policy", folder) == 0
    assert "on flights" in capsys.readouterr().out
    assert load_policy(tmp_path, trust=True).name == "tiny-int8.c"


def test_what_cannot_be_exported_or_would_write_over_the_card_of_a_policy_is_refused(
    folder, tmp_path, capsys
):
    for args, message in (
        ("--format onnx --dtype int8", "supports float32 only"),
        ("--format c --dtype int9", "unknown type 'int9'. Did you mean 'int8'"),
        ("--format", "no format"),
    ):
        assert message in refused(capsys, f"export {args} --out {tmp_path} --policy", folder)
    assert list(tmp_path.iterdir()) == []
    own = shutil.copytree(folder, tmp_path / "own")
    (own / exporting.CARD).write_text("mine")
    said = refused(capsys, "export --format c --out", own, "--policy", own)
    assert "card.md is also an input and would be overwritten" in said
    names = {path.name for path in folder.iterdir()}
    assert {path.name for path in own.iterdir()} == {*names, exporting.CARD}


def test_without_a_policy_the_default_one_is_exported(monkeypatch):
    asked = []
    monkeypatch.setattr(exporting, "export", lambda *args: asked.append(args) or {"written": []})
    assert run("export") == 0
    assert asked[0][0] == default_policy() and asked[0][2] == ("torch", "onnx")


@pytest.mark.parametrize(
    ("wanted", "file"),
    [("onnx", "policy.onnx"), more("c", "policy.c")],
)
def test_an_export_of_another_policy_is_not_written_over(
    wanted, file, folder, tmp_path, monkeypatch, capsys
):
    """Every training's policy is called policy, and C's files are called so whatever they are."""
    pytest.importorskip("onnx")
    monkeypatch.setenv("CC", "no-such-compiler")
    one, other = (tmp_path / run / "policy" for run in "ab")
    out = tmp_path / "out"

    asked = f"export --format {wanted} --out {out} --policy"
    shutil.copytree(folder, one)
    assert "not compared here" in parity.parity(out, load_policy_checkpoint(one), None).sentence
    save_policy(other, lively(SPEC, 3), SPEC, seed=1)
    assert run(asked, one) == run(asked, one) == 0
    kept = (out / file).read_bytes()
    said = f"{file} was exported from {one} and would be overwritten by the export of {other}"
    assert said in refused(capsys, asked, other)
    assert (out / file).read_bytes() == kept
    shutil.rmtree(one)
    shutil.copytree(other, one)
    assert run(asked, one) == 0, "trained on, it is the same policy's"
    assert run(asked, other) == 0, "and now that of its content, too"
    (out / exporting.NOTE).unlink()
    assert f"{file} is not recorded in exports.json" in refused(capsys, asked, other)
    (out / exporting.NOTE).write_text("[]")
    assert "not a record of exports" in refused(capsys, asked, other)


@pytest.mark.parametrize("file", ["main.c", "CMakeLists.txt", exporting.CARD])
def test_files_of_a_project_are_not_written_over(file, folder, tmp_path, capsys):
    (tmp_path / file).write_text("mine")
    said = refused(capsys, f"export --format c --out {tmp_path} --policy", folder)
    assert f"{file} is not recorded in exports.json and would be overwritten" in said
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(file, "mine")]


def test_a_card_has_the_success_of_a_shipped_policys_card(folder):
    found, stored = parity.Parity(0, "", np.nan, np.nan, None, ""), load_policy_checkpoint(folder)

    def card(name, stored=stored):
        return exporting.card_text(name, name, stored, "float32", found)

    text = card("race-paper")
    assert "95 % intervals" in text and "95 % intervals" not in card("tiny")
    assert "| race-paper | zigzag | 0 | 100 | 100 % [96, 100]" in text
    assert "no C compiler" in text and "not measured" in text
    config = {key: value for key, value in stored.config.items() if key != "seed"}
    assert "training seed unknown" in card("tiny", replace(stored, config=config))


def test_what_a_policy_is_given_on_flights_is_kept_but_for_rows_in_which_nothing_flies(monkeypatch):
    monkeypatch.setattr(parity, "TRACK", "zigzag")
    pilot = Steady((0.0, 0.0, -8.0), spec=PolicySpec(rate_hz=10.0))
    heard = parity.observed_flights(pilot, levels=(0, 1))
    assert heard.fresh.sum() == 2 and heard.fresh[0]
    assert heard.state.shape[1:] == (12,) and heard.image.shape[1:] == (24, 32)
    assert len(heard.state) == len(heard.image) == len(heard.fresh)
    # It falls: every flight starts at rest, and sinks from then on.
    assert (heard.state[heard.fresh, :3] == 0).all() and (heard.state[~heard.fresh, 2] < 0).all()
    recorder = parity.Recorder(Steady())
    hidden = recorder.start(2)
    for k, flying in enumerate(((1, 1), (1, 0), (1, 0))):
        state = np.full((2, 12), float(k + 1)) * np.array(flying)[:, None]
        fresh = np.array([k == 0, k == 0])
        _, hidden = recorder.act(hidden, state, np.zeros((2, 24, 32)), fresh)
    observed = recorder.observed()
    # Flight after flight: three steps of the first, one of the second.
    assert observed.state[:, 0].tolist() == [1.0, 2.0, 3.0, 1.0]
    assert observed.fresh.tolist() == [True, False, False, True]


@pytest.mark.extended
@needs_cc
@pytest.mark.parametrize("kind", ["acceleration", "ctbr"])
def test_the_engines_that_are_timed_are_one_policy(kind, tmp_path):
    spec = replace(SPEC, action=ActionSpec(kind))
    folder = save_policy(tmp_path / "tiny", lively(spec, 2), spec, seed=1)
    export_policy(folder, tmp_path, ["c"])
    units = {"acceleration": "m/s^2", "ctbr": "m/s^2 or rad/s"}[kind]
    sentence = parity.parity(tmp_path, load_policy_checkpoint(folder), None).sentence
    assert re.search(rf"largest difference \S+ {re.escape(units)}, median", sentence)
    more = spec.action.size - SPEC.action.size  # also of the last action in the state
    assert multiply_adds(spec) - multiply_adds(SPEC) == 2 * more * spec.hidden_size
    checkpoint = load_policy_checkpoint(folder)
    in_c = latency.c_step(load_c(tmp_path, trust=True))
    usual, _ = latency.onnx_steps(checkpoint)
    in_torch = latency.torch_step(checkpoint)
    for _ in range(3):
        action = in_c()
        assert action.shape == (1, spec.action.size)
        np.testing.assert_allclose(action, np.asarray(usual()), atol=1e-4)
        np.testing.assert_allclose(action, torch.as_tensor(in_torch()).numpy(), atol=1e-4)
