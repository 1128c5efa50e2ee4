"""Measured flights beside simulated ones as a recording, read back."""

import numpy as np
import pytest

from eval.view.comparison import Compared, Simulation, Track, write_comparison
from tests.support.recordings import columns


def track(first_s, last_s, shift=0.0):
    time_s = np.arange(first_s, last_s, 0.01)
    ahead = np.stack([time_s, np.sin(time_s) + shift, 0 * time_s + 1.0], axis=1)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    return Track(time_s, ahead, quat, np.gradient(ahead, 0.01, axis=0), 0.1 * ahead)


def flight(name="first", simulations=2):
    rollouts = [track(0.0, 1.0, 0.1), track(1.0, 2.0, 0.2)]
    errors = [np.full((len(r.time_s), 4), 0.1 * (k + 1)) for k, r in enumerate(rollouts)]
    labels = ["as given", "as named"][:simulations]
    return Compared(name, track(0.0, 2.0), [Simulation(k, rollouts, errors) for k in labels])


def test_all_that_was_given_is_in_the_recording(tmp_path):
    path = write_comparison(tmp_path / "two.rrd", [flight(), flight("second", 1)])
    assert [p.name for p in tmp_path.iterdir()] == ["two.rrd"]
    found = columns(path)
    times, poses = found["/flight_0/world/measured/drone", "Transform3D:translation"]
    np.testing.assert_allclose(np.array(poses)[:, 0], track(0.0, 2.0).pos_w, atol=1e-6)
    np.testing.assert_allclose(times, 1e9 * track(0.0, 2.0).time_s, atol=1.0)
    strips = found["/flight_0/world/as\\ given/path", "LineStrips3D:strips"][1][0]
    assert len(strips) == 2
    np.testing.assert_allclose(strips[1], track(1.0, 2.0, 0.2).pos_w, atol=1e-6)
    # A break between the rollouts, so that the line does not jump.
    values = np.array(found["/flight_1/error_position/as\\ given", "Scalars:scalars"][1])[:, 0]
    assert len(values) == 201 and np.isnan(values[100])
    np.testing.assert_allclose(values[[0, 99, 101, 200]], [0.1, 0.1, 0.2, 0.2])
    entities = {entity for entity, _ in found}
    assert "/flight_0/rates_z/as\\ named" in entities
    assert "/flight_1/rates_z/as\\ named" not in entities


def test_what_is_missing_is_left_out(tmp_path):
    lost = flight()
    lost.measured.pos_w[20:30] = np.nan
    lost.measured.vel_w[:] = np.nan
    bare = lost._replace(simulations=[Simulation("as given", [], [])])
    path = write_comparison(tmp_path / "lost.rrd", [lost, bare])
    _, poses = columns(path)["/flight_0/world/measured/drone", "Transform3D:translation"]
    assert len(poses) == 190


def test_no_flight_is_refused_and_nothing_half_written_stays(tmp_path):
    with pytest.raises(ValueError, match="at least one flight"):
        write_comparison(tmp_path / "a.rrd", [])
    assert list(tmp_path.iterdir()) == []
