"""Loops with hidden vehicles: each vehicle and seed once, kept, paired, reported if unnamed.

The loops themselves are stand-ins; tests/suite/loop has theirs.
"""

import json
import shutil

import pytest

from eval.judging.results import write_trials
from eval.quadrotor.vehicle_file import load_vehicle, save_vehicle
from policies import shipped
from suite.common.errors import WorkFailed
from suite.common.running.apart import Job
from suite.experiments import hidden_vehicles
from suite.experiments.hidden_vehicles import WORLDS, Asked, Config, loop_of, world_of
from suite.experiments.pages.hidden_vehicles import ALL
from suite.loop.config import loop_by_content
from suite.loop.hidden_effect import CONTROL, NAMED, NOMINAL
from tests.support.documents import page, reproduce
from tests.support.loops import EFFECT, WON, four_trials


@pytest.fixture
def loops(monkeypatch):
    """Return the configurations of the loops that were run; a delay is never named."""
    run = []

    def stand_in(config, out, console):
        if not (out / "diagnosis" / "stage.json").is_file():
            run.append(config)
        blind = load_vehicle(config.hidden_vehicle).effects["command_delay"].delay > 0.05
        for name, won in WON.items():
            if blind and name not in (NOMINAL, "before"):
                continue
            folder = out / f"eval-{name}"
            folder.mkdir(parents=True, exist_ok=True)
            write_trials(folder / "trials.parquet", four_trials(won, config.seed), {})
        (out / "diagnosis").mkdir(exist_ok=True)
        gap = {"before": 5.0, "after": 5.0 if blind else 1.0, "noise_floor": 1.0}
        named = {"verdict": "named", "effects": [EFFECT], "gap": gap}
        found = {**named, "verdict": "unknown", "effects": []} if blind else named
        (out / "diagnosis" / "diagnosis.json").write_text(json.dumps(found))
        (out / "diagnosis" / "stage.json").write_text("{}")
        if blind:
            raise WorkFailed("the diagnosis names nothing to correct")
        for name in (CONTROL, NAMED):
            (out / f"delta-{name}").mkdir(exist_ok=True)
            errors = {"without": {"position_m": 1.0}, "delta_action": {"position_m": 0.25}}
            (out / f"delta-{name}" / "delta.json").write_text(json.dumps(errors))

    monkeypatch.setattr(hidden_vehicles, "run_loop", stand_in)
    return run


def test_every_world_from_every_seed_once_and_found_again(loops, tmp_path):
    args = ["--policy", "race-paper", "--only", "weak rotor", "long delay", "--trials", "4"]
    args += ["--training-seeds", "0", "1", "2", "--seed", "7", "--difficulty", "3"]
    assert reproduce(tmp_path, "hidden_vehicles", *args) == 0
    assert [config.seed for config in loops] == [7, 7, 1007, 1007, 2007, 2007]
    worlds = [load_vehicle(config.hidden_vehicle) for config in loops]
    assert worlds[0] == world_of(load_vehicle("reference"), WORLDS["weak rotor"])
    assert {config.tuning.optimizer.iterations for config in loops} == {60}
    text, numbers = page(tmp_path, "hidden_vehicles")
    assert "seeds 7 to 10, 1007 to 1010, 2007 to 2010" in text
    rotor, delay, over = numbers["worlds"]
    assert [row["named"] for row in (rotor, delay, over)] == [3, 0, 3] and over["world"] == ALL
    assert rotor["gaps"]["named - control"]["of_seeds"] == [0.5, 0.5, 0.5]
    assert set(delay["success"]) == {NOMINAL, "before"} and delay["gaps"] == {}
    assert rotor["success"]["before"]["value"] == 0.5
    assert all(WORLDS[name].words in text for name in ("weak rotor", "long delay"))
    assert reproduce(tmp_path, "hidden_vehicles", *args) == 0
    assert len(loops) == 6


def test_a_loop_needs_none_of_our_files_where_it_runs(tmp_path):
    """A policy and a vehicle of one's own go along by content, and make the same loop anywhere."""
    mine, vehicle = tmp_path / "mine", tmp_path / "mine.toml"
    shutil.copytree(shipped.locate("race-paper"), mine)
    save_vehicle(load_vehicle("racer5"), vehicle)
    config = Config(policy=str(mine), vehicle=str(vehicle))
    asked = Asked(config, "weak rotor", 0, load_vehicle(str(vehicle)))
    here = loop_by_content(loop_of(Job(asked, tmp_path / "here", mine)))
    shutil.move(mine, tmp_path / "reads")
    vehicle.unlink()
    there = loop_by_content(loop_of(Job(asked, tmp_path / "there", tmp_path / "reads")))
    assert here == there and set(here.digests) == {"policy", "vehicle", "sensors", "hidden_vehicle"}
