"""The Python interface; messages about a user's own policy file, track file and working folder."""

import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import onnx
import pytest
import torch

import suite
from eval.effects import EFFECTS
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import WORLDS
from eval.worlds.engine import refuse_start_contact
from policies.contract import contract_of
from policies.formats.export import export_module
from policies.spec import PolicySpec
from suite.commands import check
from suite.common.console import Quiet
from suite.diagnose.example import flights as example
from suite.judging import checking
from suite.judging.trials import _in_millimetres, _too_small
from tests.support.courses import straight
from tracks.families import FAMILIES

FLIGHT = min(path.name for path in example.FOLDER.glob("*.parquet"))


def test_a_start_that_touches_the_ground_is_refused_and_a_track_in_millimetres_reported():
    vehicle, track = load_vehicle("racer5"), straight()
    refuse_start_contact("here", track, vehicle)
    low = replace(track, start_pos_w=np.array([*track.start_pos_w[:2], 0.02]))
    with pytest.raises(ValueError, match="here: at start.position .* touches ground; move"):
        refuse_start_contact("here", low, vehicle)
    track = straight()
    assert _in_millimetres("here", track) == []
    gates = track.scene.gates._replace(center_w=1000 * track.scene.gates.center_w)
    gates = gates._replace(opening_g=1000 * gates.opening_g)
    large = replace(track, scene=track.scene._replace(gates=gates))
    assert "millimetres" in _in_millimetres("here", large)[0]
    assert _too_small("here", track, vehicle) == []
    small = gates._replace(opening_g=gates.opening_g * [1e-3, 1e-5])
    narrow = replace(track, scene=track.scene._replace(gates=small))
    assert "here: gate 0 is" in _too_small("here", narrow, vehicle)[0]


def test_modules_in_the_working_folder_do_not_stand_for_ours_or_pythons(tmp_path, root):
    for name in ("eval", "socket", "tokenize"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('mine')\n")
    code = (
        f"import sys; sys.path[0] = {str(root)!r}; import socket, tokenize\n"
        "from suite import cli\n"
        "from tracks.common.work.processes import worker_pool\n"
        "sys.path.insert(0, ''); sys.argv[1:] = ['effects']; main = cli.main\n"
        # A process of its own begins as those that fly trials do.
        "cli.main = lambda: main() or worker_pool(1).submit(int, 0).result()\n"
        "cli.entry()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0 and "mine" not in done.stderr, done.stderr


def test_files_come_back_and_a_program_registers_names_for_its_process(tmp_path, monkeypatch):
    vehicle, log = suite.load_vehicle("racer5"), suite.read_flight(example.FOLDER / FLIGHT)
    suite.save_vehicle(vehicle, tmp_path / "it.toml")
    assert suite.load_vehicle(tmp_path / "it.toml") == vehicle
    again = suite.read_flight(suite.write_flight(tmp_path / "it.parquet", log))
    np.testing.assert_array_equal(again.pos_w, log.pos_w)
    effect = replace(EFFECTS["linear_drag"], name="mine")
    for registry, value, register in (
        (EFFECTS, effect, suite.register_effect),
        (FAMILIES, lambda difficulty, rng: None, partial(suite.register_track, "mine")),
        (WORLDS, type("Mine", (), {}), partial(suite.register_simulator, "mine")),
    ):
        for held in ("_entries", "_values"):
            monkeypatch.setattr(registry, held, dict(getattr(registry, held)))
        register(value)
        assert registry["mine"] is value
        with pytest.raises(ValueError, match="'mine' exists already"):
            register(value)


def test_check_reports_the_contract_and_an_unscaled_file_that_says_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(checking, "TIME_LIMIT_S", 1.5)
    answer = check.run(check.Config(policy="race-small", trials=1), Quiet())
    assert answer["findings"] == [] and answer["contract"]["digest"]
    with pytest.raises(ValueError, match="nothing to check"):
        check.run(check.Config(), Quiet())

    class Unscaled(torch.nn.Module):
        def forward(self, state, image):
            return torch.tanh(state[:, 6:9]) + 0 * image.mean((1, 2))[:, None]

    path = export_module(Unscaled(), tmp_path / "it.onnx", PolicySpec())
    proto = onnx.load(path)
    del proto.metadata_props[:]
    onnx.save(proto, path)
    answer = check.run(check.Config(policy=str(path), trials=1), Quiet())
    faults = [finding["fault"] for finding in answer["findings"]]
    assert faults[0] == "no_contract" and "action_scale" in faults
    assert "30 Hz" in answer["findings"][0]["evidence"]
    assert answer["contract"]["digest"] == contract_of(PolicySpec()).digest
