"""Recordings of flights and of comparisons hold what was given; they are read back to see that."""

import numpy as np
import pytest
import rerun.chunk

from eval.view import colours
from eval.view.blueprint import Tab, trial_view
from eval.view.comparison import ComparedFlight, Simulation, States, write_comparison
from eval.view.recording import write_recording
from tests.support.flights import rollout
from tests.support.recordings import columns
from tracks.geometry.camera import Camera, pixel_rays_b


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A recording of a flight that finished and of one that collided (ctbr), and its columns."""
    path = tmp_path_factory.mktemp("rrd") / "two.rrd"
    track, flight, result = rollout("collision", 1.5, False)
    action = np.column_stack([flight.thrust_cmd, flight.rate_cmd_b])
    flight = flight._replace(action_b=action, action_kind="ctbr")
    assert write_recording(path, [rollout(), (track, flight, result)]) == path
    assert [p.name for p in path.parent.iterdir()] == ["two.rrd"]
    return path, columns(path)


def nanoseconds(time_s):
    return np.round(time_s * 1e9).astype(np.int64)


def test_a_recording_holds_every_row_of_the_flight(recorded):
    _, found = recorded
    _, flight, _ = rollout()
    for name, values in {
        "speed": np.linalg.norm(flight.vel_w, axis=1)[:, None],
        "thrust/command": flight.thrust_cmd[:, None],
        "rates/measured": flight.rate_b,
        "rates/command": flight.rate_cmd_b,
        "rotors": flight.rotor_speed,
    }.items():
        times, scalars = found[f"/trial_0/{name}", "Scalars:scalars"]
        np.testing.assert_array_equal(times, nanoseconds(flight.time_s))
        np.testing.assert_array_equal(scalars, values)
    step = flight.policy_step
    times, scalars = found["/trial_0/action", "Scalars:scalars"]
    np.testing.assert_array_equal(times, nanoseconds(flight.time_s[step]))
    np.testing.assert_array_equal(scalars, flight.action_b[step])
    for entity in ("speed", "rates/measured", "rotors"):
        assert found[f"/trial_0/{entity}", "SeriesLines:names"][0] is None
    names = [found[f"/trial_{k}/action", "SeriesLines:names"][1][0] for k in (0, 1)]
    assert names == [["x", "y", "z"], ["thrust", "roll_rate", "pitch_rate", "yaw_rate"]]


def test_a_recording_moves_the_drone_as_it_flew(recorded):
    _, found = recorded
    _, flight, _ = rollout()
    drone = "/trial_0/world/drone"
    times, places = found[drone, "Transform3D:translation"]
    np.testing.assert_array_equal(times, nanoseconds(flight.time_s))
    np.testing.assert_allclose(np.squeeze(places, 1), flight.pos_w, rtol=1e-6)
    xyzw = np.squeeze(found[drone, "Transform3D:quaternion"][1], 1)
    np.testing.assert_allclose(np.roll(xyzw, 1, axis=1), flight.quat_wxyz, atol=1e-6)
    assert (f"{drone}/body", "Boxes3D:half_sizes") in found


def test_a_recording_has_the_depth_images_in_metres_at_the_policys_rate(recorded):
    _, found = recorded
    _, flight, _ = rollout()
    entity = "/trial_0/world/drone/camera/depth"
    times, buffers = found[entity, "DepthImage:buffer"]
    np.testing.assert_array_equal(times, nanoseconds(flight.depth_time_s))
    images = np.array(buffers, dtype=np.uint8).reshape(len(times), -1).view(np.float32)
    assert flight.depth_m is not None
    np.testing.assert_array_equal(images.reshape(-1, 24, 32), flight.depth_m)
    assert found[entity, "DepthImage:meter"][1] == [[1.0]]
    layout = found[entity, "DepthImage:format"][1][0][0]
    assert (layout["width"], layout["height"]) == (32, 24)
    assert not any("/trial_1" in entity and "camera" in entity for entity, _ in found)


def test_the_recorded_camera_has_the_rays_of_ours(recorded):
    _, found = recorded
    eye = "/trial_0/world/drone/camera"
    camera = Camera()
    matrix = np.reshape(found[eye, "Pinhole:image_from_camera"][1], (3, 3)).T
    mount = np.reshape(found[eye, "Transform3D:mat3x3"][1], (3, 3)).T
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixel = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    rays_b = pixel @ np.linalg.inv(matrix).T @ mount.T
    np.testing.assert_allclose(rays_b, pixel_rays_b(camera), atol=1e-5)


def test_gates_turn_colour_when_they_are_passed(recorded):
    _, found = recorded
    for number, (track, flight, _) in enumerate((rollout(), rollout("collision", 1.5, False))):
        for gate in range(len(track.scene.gates.center_w)):
            entity = f"/trial_{number}/world/gates/{gate}"
            times, values = found[entity, "Mesh3D:albedo_factor"]
            shades = [tuple(value[0].to_bytes(4, "big")[:3]) for value in values]
            passed = np.flatnonzero(flight.gate > gate)
            assert shades == [colours.AHEAD, colours.PASSED][: 1 + (len(passed) > 0)]
            assert list(times[1:]) == list(nanoseconds(flight.time_s[passed[:1]]))
            assert found[entity, "Mesh3D:vertex_positions"][0] is None


def test_obstacles_path_end_and_events_are_there(recorded):
    path, found = recorded
    track, flight, result = rollout("collision", 1.5, False)
    entities = {entity.replace("\\", "") for entity, _ in found}
    for name in ("plate 0", "pillar 0", "capsule 0", "sphere 0"):
        assert f"/trial_1/world/obstacles/{name}" in entities
    strips = found["/trial_1/world/path", "LineStrips3D:strips"][1][0]
    assert len(strips) == len(flight.time_s) - 1
    assert len(set(found["/trial_1/world/path", "LineStrips3D:colors"][1][0])) > 10
    end = found["/trial_1/world/end", "Points3D:positions"][1][0]
    np.testing.assert_allclose(end, [[result.pos_x, result.pos_y, result.pos_z]], rtol=1e-6)
    label = found["/trial_1/world/end", "Points3D:labels"][1][0]
    assert label == ["collision with pillar 0"]
    times, texts = found["/trial_1/events", "TextLog:text"]
    assert texts == [["gate 0 passed"], ["collision with pillar 0"]]
    assert times[-1] == nanoseconds(flight.time_s[-1])
    about = {name for entity, name in found if entity == "/__properties/suite"}
    assert {"schema", "suite_version"} <= {name.split(":")[-1] for name in about}


def test_a_full_disk_names_the_recording_and_leaves_none(tmp_path, monkeypatch):
    def full(self, **options):
        raise RuntimeError("File-writer thread shut down prematurely")

    monkeypatch.setattr(rerun.RecordingStream, "flush", full)
    with pytest.raises(OSError, match=r"the disk may be full.*flight\.rrd"):
        write_recording(tmp_path / "flight.rrd", [rollout()])
    assert list(tmp_path.iterdir()) == []


def test_recordings_of_nothing_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one rollout"):
        write_recording(tmp_path / "a.rrd", [])
    with pytest.raises(ValueError, match="at least one flight"):
        write_comparison(tmp_path / "a.rrd", [])
    assert not list(tmp_path.iterdir())


def test_a_recording_opens_laid_out(recorded):
    path, _ = recorded
    reader = rerun.chunk.RrdReader(path)
    (blueprint,) = reader.blueprints()
    (data,) = reader.recordings()
    assert blueprint.application_id == data.application_id
    found = columns(path, blueprint)
    by_name = {name: [] for _, name in found}
    for (_, name), (_, values) in found.items():
        by_name[name].append(values[0][0])
    kinds = by_name["ViewBlueprint:class_identifier"]
    # Two trials: two 3D views each, five plots, the events; only the first one saw depth images.
    titles = {"policy's action, body [m/s²]", "policy's action"}
    assert titles <= set(by_name["ViewBlueprint:display_name"])
    counts = {kind: kinds.count(kind) for kind in set(kinds)}
    assert counts == {"3D": 4, "2D": 1, "TimeSeries": 10, "TextLog": 2}
    origins = set(by_name["ViewBlueprint:space_origin"])
    assert {"/trial_0/world", "/trial_0/world/drone/camera", "/trial_1/speed"} <= origins
    shown = {entity for entity, _ in columns(path)}
    assert all(any(entity.startswith(origin) for entity in shown) for origin in origins)
    # It plays from just before the first gate.
    flight = rollout()[1]
    gate_s = flight.time_s[flight.gate > 0][0]
    (shown,) = by_name["TimePanelBlueprint:time_selection"]
    assert max(0.0, gate_s - 1.0) <= shown["min"] / 1e9 < gate_s < shown["max"] / 1e9
    assert "zigzag level 3 seed 5: collision" in by_name["ContainerBlueprint:display_name"]


def track(first_s, last_s, shift=0.0):
    time_s = np.arange(first_s, last_s, 0.01)
    ahead = np.stack([time_s, np.sin(time_s) + shift, 0 * time_s + 1.0], axis=1)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(time_s), 1))
    return States(time_s, ahead, quat, np.gradient(ahead, 0.01, axis=0), 0.1 * ahead)


def flight(name="first", simulations=2):
    rollouts = [track(0.0, 1.0, 0.1), track(1.0, 2.0, 0.2)]
    errors = [np.full((len(r.time_s), 4), 0.1 * (k + 1)) for k, r in enumerate(rollouts)]
    labels = ["as given", "as named"][:simulations]
    return ComparedFlight(name, track(0.0, 2.0), [Simulation(k, rollouts, errors) for k in labels])


def test_what_is_missing_is_left_out(tmp_path):
    lost = flight()
    lost.measured.pos_w[20:30] = np.nan
    lost.measured.vel_w[:] = np.nan
    bare = lost._replace(simulations=[Simulation("as given", [], [])])
    path = write_comparison(tmp_path / "lost.rrd", [lost, bare])
    assert [p.name for p in tmp_path.iterdir()] == ["lost.rrd"]
    found = columns(path)
    assert len(found["/flight_0/world/measured/drone", "Transform3D:translation"][1]) == 190
    # A break between the rollouts, so that the line does not jump.
    values = np.array(found["/flight_0/error_position/as\\ given", "Scalars:scalars"][1])[:, 0]
    assert len(values) == 201 and np.isnan(values[100])
    np.testing.assert_allclose(values[[0, 99, 101, 200]], [0.1, 0.1, 0.2, 0.2])


def test_what_was_not_logged_has_no_panel(tmp_path):
    def panels(number):
        """Return the origins of the plots of a flight that lacks the velocity from `number` on."""
        lost = flight(simulations=1)
        for states in [lost.measured, *lost.simulations[0].rollouts][number:]:
            states.vel_w[:] = np.nan
        for error in lost.simulations[0].errors:
            error[:, 1] = np.nan
        path = write_comparison(tmp_path / "lost.rrd", [lost])
        (blueprint,) = rerun.chunk.RrdReader(path).blueprints()
        found = columns(path, blueprint).items()
        origins = [v[0][0] for (_, n), (_, v) in found if n == "ViewBlueprint:space_origin"]
        return {origin.removeprefix("/flight_0/") for origin in origins} - {"world"}

    of_rates = {"rates_x", "rates_y", "rates_z"}
    assert panels(0) == {"error_position", "error_attitude", "error_rates", *of_rates}
    assert panels(1) - panels(0) == {"velocity_x", "velocity_y", "velocity_z"}


def test_a_policy_of_motor_commands_has_no_plot_of_thrust_commands():
    def has_thrust(kind):
        tab = Tab("/trial_0", "title", False, np.zeros(3), np.ones(3), kind)
        others = next(part for part in trial_view(tab).contents[1].contents if part.name is None)
        return "thrust command [m/s²]" in [view.name for view in others.contents]

    assert has_thrust("ctbr") and not has_thrust("motors")


def test_the_playback_begins_in_the_recorded_part_of_a_flight(tmp_path):
    """Only the held-out end of a single flight is recorded."""
    late = ComparedFlight("late", track(7.0, 9.0), [])
    path = write_comparison(tmp_path / "late.rrd", [late])
    (blueprint,) = rerun.chunk.RrdReader(path).blueprints()
    found = columns(path, blueprint)
    (shown,) = (v for (_, n), (_, v) in found.items() if n.endswith(":time_selection"))
    span = shown[0][0]
    assert span["min"] / 1e9 == pytest.approx(7.2, abs=0.01)
    assert span["max"] / 1e9 == pytest.approx(8.99)
