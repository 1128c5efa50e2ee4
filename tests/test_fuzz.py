"""Odd inputs of every kind: each is used, or refused in a line; no traceback, no wait.

At a small size with all tests; `pytest -m slow tests/test_fuzz.py` tries 1,000 of each kind of our
own files and 10,000 of each foreign format and of sensors files, in parts that draw from seeds of
their own.
"""

import json
import shutil
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, seed, settings

from eval.importers import import_log
from eval.importers.formats.table import read_map
from eval.importers.options import ImportOptions
from eval.judging.results import Journal, read_trials, write_trials
from eval.logs.flight_log import read_flight, write_flight
from eval.quadrotor.vehicle_file import load_vehicle
from eval.sensors.sensors_file import PRESETS, load_sensors
from policies import shipped
from policies.formats.onnx_file import read_checked
from policies.formats.policy_file import load_policy_checkpoint
from suite.common.errors import UNUSABLE, explain
from suite.judging.replay import read_evaluation
from suite.judging.requests import Evaluation
from suite.train.config import check
from suite.train.overrides import with_changes
from suite.train.recipes import named_recipe, with_quadrotor
from tests.support import foreign_logs, known_flight, raw_logs
from tests.support.judged_cells import ROWS
from tests.support.mutations import changes, mutated_bytes, mutated_json, mutated_toml
from tests.support.policy_files import onnx_model
from tracks.common.files import plain
from tracks.formats.custom import load_track
from tracks.formats.mesh_reader import load_convex_parts

ROOT = Path(__file__).resolve().parents[1]
KINDS = (
    *("set", "vehicle", "sensors", "track", "mapping", "checkpoint", "policy.onnx"),
    *("flight.parquet", "flight.csv", "run.json", "journal"),
)
FOREIGN = (
    *("ulg", "mcap", "blackbox", "bbl", "bin", "usd"),
    *("trials.parquet", "obj", "stl", "glb", "ply"),
)
"""Formats that other programs write, or that others hand over."""
EACH, PARTS_FOREIGN = 1000, 10
"""Inputs of each kind at full size, and how many times as many of foreign and sensors files."""
FULL = [
    *((kind, 0) for kind in KINDS if kind != "sensors"),
    *((kind, part) for kind in (*FOREIGN, "sensors") for part in range(PARTS_FOREIGN)),
]
"""Each (kind, part) at full size."""
MEMORY_BYTES = 3 * 2**29
"""These tests never add more to this process; that which reads meshes has a limit of its own."""
SLOW = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.function_scoped_fixture]
WITHIN_S = 10.0
"""None takes longer."""
TOML = {
    "vehicle": ("examples/hidden.toml", load_vehicle),
    "sensors": (PRESETS / "all.toml", load_sensors),
    "track": ("tracks/examples/yard.toml", load_track),
    "mapping": ("eval/importers/mappings/nanobench.toml", read_map),
}
"""A kind of TOML file: a valid one, and its reader."""


def answered(use, *given):
    """Use an input, which works or is refused in a line that is for people."""
    started = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            use(*given)
        except Exception as error:
            told = explain(error)
            if told is None:
                raise
            assert told[0] == UNUSABLE and len(told[1].splitlines()) <= 2, told
    assert time.monotonic() - started < WITHIN_S


def a_flight(folder, ending):
    log = read_flight(ROOT / "suite" / "diagnose" / "example" / "flight_1.parquet")
    parts = {k: v[:150] for k, v in vars(log).items() if hasattr(v, "shape") and v.ndim}
    return write_flight(folder / f"flight{ending}", replace(log, **parts)).read_bytes()


def a_foreign_file(kind, folder):
    """Return the bytes of a short flight, a table or a mesh as other programs write it."""
    path, short = folder / "whole", (0.0, 1.2)
    writers = {
        "ulg": lambda: foreign_logs.write_ulog(path, short, rate=100.0),
        "mcap": lambda: foreign_logs.write_mcap(path, short),
        "blackbox": lambda: foreign_logs.write_blackbox(path, short, rate=200.0),
        "usd": lambda: foreign_logs.write_usd(path, short),
        "bbl": lambda: raw_logs.write_raw(path, known_flight.fly(np.arange(*short, 0.01))),
        "bin": lambda: raw_logs.write_bin(path, known_flight.fly(np.arange(*short, 0.01))),
        "trials.parquet": lambda: write_trials(path, ROWS, {}),
    }
    if kind in writers:
        writers[kind]()
    else:
        trimesh.creation.icosphere(1).export(path, file_type=kind)
    return path.read_bytes()


def foreign_reader(kind):
    """Return what reads a foreign file."""
    if kind == "trials.parquet":
        return read_trials
    if kind in ("obj", "stl", "glb", "ply"):
        return lambda path: load_convex_parts([path])
    # Of a partial log more is read than of one whose first fault ends it.
    options = ImportOptions(partial=True, full_thrust=30.0)
    names = {"ulg": "px4", "usd": "crazyflie", "bin": "ardupilot"}
    name = "betaflight" if kind in ("blackbox", "bbl") else names.get(kind, kind)
    return lambda path: import_log(path, name, options)


def drawn_and_used(kind, folder):
    """Return the strategy of a kind of input, and what uses one."""
    if kind == "set":
        recipe = with_quadrotor(named_recipe("race"), load_vehicle("racer5"))
        return changes(recipe), lambda change: check(with_changes(recipe, [change]))
    name, ending = "odd", Path(kind).suffix
    if kind in FOREIGN:
        name, valid, read = f"odd.{kind}", a_foreign_file(kind, folder), foreign_reader(kind)
        drawn = mutated_bytes(valid)
    elif kind in TOML:
        place, read = TOML[kind]
        for mesh in (ROOT / place).parent.glob("*.obj"):
            shutil.copy(mesh, folder)
        name, valid = "odd.toml", (ROOT / place).read_bytes()
        drawn = mutated_toml(valid.decode())
    elif kind == "checkpoint":
        source = shipped.locate("race-paper")
        (folder / "weights.safetensors").write_bytes((source / "weights.safetensors").read_bytes())
        name, valid = "config.json", (source / "config.json").read_bytes()
        drawn, read = mutated_json(json.loads(valid)), lambda _: load_policy_checkpoint(folder)
    elif kind == "policy.onnx":
        name, valid, read = "odd.onnx", onnx_model().SerializeToString(), read_checked
        drawn = mutated_bytes(valid)
    elif kind in ("flight.parquet", "flight.csv"):
        name, valid, read = f"odd{ending}", a_flight(folder, ending), read_flight
        drawn = mutated_bytes(valid)
    elif kind == "run.json":
        name, record = "run.json", {"config": plain(Evaluation())}
        valid = json.dumps(record).encode()
        drawn, read = mutated_json(record), lambda _: read_evaluation(folder)
    else:
        Journal(folder / name, {"a": 1}).close()
        line = b'{"track": "zigzag", "difficulty": 0, "seed": 0}\n'
        valid = (folder / name).read_bytes()
        drawn, read = mutated_bytes(valid + line), lambda path: Journal(path, {"a": 1}).close()

    def filed(data):
        (folder / name).write_bytes(data)
        read(folder / name)

    filed(valid)
    return drawn, filed


def fuzz(kind, folder, count, part=0):
    inputs, use = drawn_and_used(kind, folder)

    @seed(part)
    @settings(max_examples=count, deadline=None, suppress_health_check=SLOW)
    @given(inputs)
    def each(given_input):
        answered(use, given_input)

    each()


@pytest.mark.parametrize("kind", (*KINDS, *FOREIGN))
def test_odd_inputs_are_used_or_refused_in_a_line(kind, tmp_path, capfd):
    fuzz(kind, tmp_path, 10)
    assert capfd.readouterr() == ("", ""), "libraries print nothing"


def memory_bytes(key):
    """Return an entry of this process's memory: VmRSS now, or VmHWM at the most."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(f"{key}:"))


@pytest.fixture(scope="module")
def memory_before():
    """Begin a new peak of this process's memory, without that of other tests."""
    Path("/proc/self/clear_refs").write_text("5")
    return memory_bytes("VmRSS")


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "part"), FULL)
def test_many_odd_inputs_are_used_or_refused_in_a_line(kind, part, tmp_path, memory_before):
    fuzz(kind, tmp_path, EACH, part)
    assert memory_bytes("VmHWM") - memory_before < MEMORY_BYTES
