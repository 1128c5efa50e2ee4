"""Flights as a state estimator would have logged them, cut before they touch anything."""

import json
from dataclasses import replace

import numpy as np
import pytest

from eval.logs.flight_log import read_flights, write_flight
from suite.delta.replay import nominal_model
from suite.loop.measured import (
    CONTACT_MARGIN_S,
    Noise,
    add_measurement_noise,
    cut_end,
    first_files,
    noisy,
)
from suite.train.config import PointMassConfig
from tests.support.point_mass_flights import fly


@pytest.fixture(scope="module")
def logs():
    flown = fly(nominal_model(PointMassConfig()), 3, seconds=4.0)
    thrust = np.full_like(flown[0].time_s, 9.81)
    return [replace(log, thrust_cmd=thrust, rate_cmd_b=log.rate_b) for log in flown]


def test_ends_are_cut_and_noise_is_of_its_size(logs):
    log = logs[0]
    short = cut_end(log, 0.5)
    assert log.time_s[-1] - short.time_s[-1] == pytest.approx(0.5, abs=0.034)
    assert len(short.pos_w) == len(short.extra["action_x"]) == len(short.time_s) < len(log.time_s)
    shaken = noisy(log, Noise(), np.random.default_rng(0))
    turn = np.einsum("nij,nik->njk", log.rot_w, shaken.rot_w)
    angle = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], -1)
    assert angle.std() == pytest.approx(Noise().attitude, rel=0.2)
    assert (shaken.rate_b - log.rate_b).std() == pytest.approx(Noise().gyro, rel=0.2)
    np.testing.assert_allclose(np.linalg.norm(shaken.quat_wxyz, axis=1), 1, atol=1e-12)
    np.testing.assert_array_equal(shaken.thrust_cmd, log.thrust_cmd)


def test_crashed_flights_lose_their_end_and_short_ones_are_left_out(logs, tmp_path):
    flights, out = tmp_path / "flights", tmp_path / "out"
    rows = [{"file": None, "track": "zigzag", "difficulty": 0, "ended_by": "collision"}]
    # The last is too short to be used.
    flown = (*logs[:2], cut_end(logs[2], logs[2].duration_s - 1.2))
    for log, ended_by in zip(flown, ("collision", "timeout", "finished"), strict=True):
        file = write_flight(flights / f"{ended_by}.parquet", log)
        rows.append({**rows[0], "file": file.name, "ended_by": ended_by})
    (flights / "flights.json").write_text(json.dumps({"flights": rows}))
    files = add_measurement_noise(flights, out, 0)
    assert [file.name for file in files] == ["collision.parquet", "timeout.parquet"]
    kept = [read_flights([file])[0][0].duration_s for file in files]
    assert logs[0].duration_s - kept[0] == pytest.approx(CONTACT_MARGIN_S, abs=0.034)
    assert logs[1].duration_s == kept[1]
    (flights / "flights.json").write_text(json.dumps({"flights": rows[:1]}))
    with pytest.raises(ValueError, match="no flight in .* is 1.5 s long"):
        add_measurement_noise(flights, tmp_path / "none", 0)


def test_the_diagnosis_gets_five_flights_or_as_many_as_are_long_enough(logs, tmp_path):
    files = [tmp_path / f"{number}.parquet" for number in range(7)]
    for file in files:
        write_flight(file, logs[0])
    assert first_files(files, 1.0) == files[:5]
    assert first_files(files, 5.5 * logs[0].duration_s) == files[:6]
    assert first_files(files, 99.0 * logs[0].duration_s) == files
