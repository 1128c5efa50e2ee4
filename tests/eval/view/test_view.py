"""Recordings, pictures and videos show what was flown, and are read back to see that."""

import subprocess
import sys
from functools import cache

import imageio_ffmpeg
import numpy as np
import pytest
import rerun.chunk
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image, ImageSequence
from scipy.spatial import ConvexHull

from eval.view import colours
from eval.view.picture import write_grid, write_picture
from eval.view.recording import Drone, write_recording
from eval.view.scene3d import Faces, Lines, look_at, paint, to_camera, to_pixels
from eval.view.solids import flat_normals, joined, outline, track_solids
from eval.view.video import (
    DEPTH_RANGE_M,
    VideoOptions,
    _beyond,
    frame_times,
    video_frames,
    write_video,
)
from tests.support.flights import result_of, small_track, smooth_flight
from tests.support.recordings import columns
from tracks.geometry.camera import Camera, pixel_rays_b
from tracks.geometry.rotation import quat_to_rot

SMALL = VideoOptions(size=(160, 96), fps=10, hold_s=0.3)
NO_LINES = Lines(np.zeros((0, 2, 3)), np.zeros((0, 3)), 0.01)


@cache
def rollout(ended_by="finished", duration_s=None, depth=True):
    track = small_track()
    flight = smooth_flight(track, duration_s=duration_s, depth=depth)
    return track, flight, result_of(track, flight, ended_by)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("rrd") / "two.rrd"
    crash = rollout("collision", 1.5, False)
    assert write_recording(path, [rollout(), crash]) == path
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
    np.testing.assert_array_equal(times, nanoseconds(flight.time_s[flight.policy_step]))
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
    counts = {kind: kinds.count(kind) for kind in set(kinds)}
    assert counts == {"3D": 4, "2D": 1, "TimeSeries": 10, "TextLog": 2}
    origins = set(by_name["ViewBlueprint:space_origin"])
    assert {"/trial_0/world", "/trial_0/world/drone/camera", "/trial_1/speed"} <= origins
    shown = {entity for entity, _ in columns(path)}
    assert all(any(entity.startswith(origin) for entity in shown) for origin in origins)
    # It plays from just before the first gate, with the time in sight.
    flight = rollout()[1]
    gate_s = flight.time_s[flight.gate > 0][0]
    (shown,) = by_name["TimePanelBlueprint:time_selection"]
    begin, end = shown["min"] / 1e9, shown["max"] / 1e9
    assert max(0.0, gate_s - 1.0) <= begin < gate_s < end
    assert by_name["PanelBlueprint:state"] or by_name["TimePanelBlueprint:state"]
    titles = by_name["ContainerBlueprint:display_name"]
    assert "zigzag level 3 seed 5: collision" in titles


def test_the_rerun_command_finds_the_recording_sound(recorded):
    path, _ = recorded
    command = [sys.executable, "-m", "rerun", "rrd", "verify", path]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_recordings_of_nothing_and_of_a_folder_are_refused(tmp_path):
    with pytest.raises(ValueError, match="at least one rollout"):
        write_recording(tmp_path / "a.rrd", [])
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError):
        write_recording(tmp_path / "file" / "a.rrd", [rollout()])


def test_a_diverged_flight_can_still_be_seen(tmp_path):
    track, flight, result = rollout()
    pos = flight.pos_w.copy()
    pos[-3:] = np.nan
    vel = flight.vel_w.copy()
    vel[-2:] = np.nan
    lost = flight._replace(pos_w=pos, vel_w=vel)
    result = result._replace(ended_by="diverged")
    write_recording(tmp_path / "a.rrd", [(track, lost, result)], Drone(camera=Camera(pitch_deg=0)))
    write_picture(tmp_path / "a.png", track, lost, result)
    write_video(tmp_path / "a.gif", track, lost, result, SMALL)
    strips = columns(tmp_path / "a.rrd")["/trial_0/world/path", "LineStrips3D:strips"][1][0]
    assert len(strips) == len(pos) - 4


def opened(path):
    with Image.open(path) as image:
        return image.convert("RGB")


def share(image, colour, tolerance=12):
    """The share of pixels near a colour."""
    away = np.abs(np.asarray(image, dtype=int) - np.array(colour)).max(axis=-1)
    return float((away <= tolerance).mean())


def test_pictures_show_track_path_gates_and_end(tmp_path):
    track, flight, result = rollout()
    crash = rollout("collision", 1.5, False)
    write_picture(tmp_path / "bare.png", track)
    write_picture(tmp_path / "flown.png", track, flight, result)
    write_picture(tmp_path / "crash.png", *crash)
    bare, flown, hit = (opened(tmp_path / f"{n}.png") for n in ("bare", "flown", "crash"))
    assert share(bare, colours.AHEAD) > 1e-3 and share(bare, colours.PASSED) == 0
    assert share(flown, colours.PASSED) > 1e-3 and share(flown, colours.AHEAD, 2) < 2e-4
    assert share(hit, colours.CRASH, 4) > 1e-4 > share(flown, colours.CRASH, 4)
    assert share(hit, colours.AHEAD) > 1e-3 and share(hit, colours.PASSED) > 2e-4
    assert share(bare, colours.START) > 1e-4
    assert bare.size[0] > 600 and bare.size[1] > 250


def test_a_grid_has_a_panel_a_trial(tmp_path):
    trials = [rollout(), rollout("collision", 1.5, False), (small_track(6, seed=2), None, None)]
    write_grid(tmp_path / "one.png", trials[:1])
    write_grid(tmp_path / "three.png", trials, columns=2)
    one, three = opened(tmp_path / "one.png"), opened(tmp_path / "three.png")
    assert three.size[0] > 1.6 * one.size[0] and three.size[1] > 1.6 * one.size[1]
    with pytest.raises(ValueError, match="at least one trial"):
        write_grid(tmp_path / "none.png", [])


@pytest.mark.parametrize("kind", ["mp4", "gif"])
def test_a_video_plays_the_whole_flight(tmp_path, kind):
    done = []
    path = tmp_path / f"a.{kind}"
    track, flight, result = rollout()
    write_video(path, track, flight, result, SMALL, done.append)
    expected = len(frame_times(flight, SMALL))
    assert done == list(range(1, expected + 1))
    assert abs(expected / SMALL.fps - flight.time_s[-1] - SMALL.hold_s) < 0.11
    if kind == "gif":
        with Image.open(path) as video:
            assert video.size == SMALL.size
            # Frames that are alike are one that stays longer.
            lasting = sum(frame.info["duration"] for frame in ImageSequence.Iterator(video))
        assert lasting == expected * 1000 / SMALL.fps
        return
    decoder = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-i",
        path,
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    done = subprocess.run(decoder, capture_output=True, check=True)
    stream = done.stderr.decode().split("Output #0")[0]
    assert "h264" in stream and "yuv420p" in stream and "160x96" in stream and "10 fps" in stream
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 96, 160, 3)
    assert len(frames) == expected
    painted = list(video_frames(track, flight, result, SMALL))
    for number in (0, expected // 2, expected - 1):
        error = np.abs(frames[number].astype(int) - np.asarray(painted[number]).astype(int))
        assert error.mean() < 6


def test_a_video_that_fails_or_is_interrupted_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(number):
        raise KeyboardInterrupt

    for kind in ("mp4", "gif"):
        with pytest.raises(KeyboardInterrupt):
            write_video(tmp_path / f"a.{kind}", *rollout(), SMALL, interrupt)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: "false")
    with pytest.raises(OSError, match=r"a\.mp4: the video encoder failed"):
        write_video(tmp_path / "a.mp4", *rollout(), SMALL)
    assert not list(tmp_path.iterdir())


def test_a_trial_without_a_row_can_still_be_seen(tmp_path):
    track, flight, result = rollout()
    arrays = {name: getattr(flight, name)[:0] for name in type(flight)._fields[:-2]}
    write_picture(tmp_path / "a.png", track, flight._replace(**arrays), result)
    write_grid(tmp_path / "b.png", [(track, flight._replace(**arrays), result)])
    write_recording(tmp_path / "a.rrd", [(track, flight._replace(**arrays), result)])
    assert ("/trial_0/world/end", "Points3D:positions") in columns(tmp_path / "a.rrd")
    assert share(opened(tmp_path / "a.png"), colours.PASSED) > 1e-3


def test_the_video_shows_drone_depth_and_gates():
    track, flight, result = rollout()
    frames = list(video_frames(track, flight, result, VideoOptions((480, 270), 5, hold_s=0.2)))
    assert share(frames[0], colours.AHEAD, 50) > 3e-3
    assert share(frames[0], colours.DRONE, 12) > 5e-4
    assert share(frames[-1], colours.PASSED, 2) > 5e-4  # the word at the end
    greens = []
    for frame in frames[:-1]:
        red, green, blue = np.moveaxis(np.asarray(frame, dtype=int)[100:, :320], -1, 0)
        greens.append(((green > 1.5 * red) & (green > 1.2 * blue)).mean())
    # No gate is green before it was passed; just behind it the eye sees it green.
    assert greens[0] == 0 < max(greens[2:])
    # Beside it, in the right third and at its middle: what it saw, pixel for pixel.
    seen = np.asarray(frames[0])[75:195, 320:480]
    assert flight.depth_m is not None
    want = colours.depth_colours(flight.depth_m[0], DEPTH_RANGE_M)
    np.testing.assert_array_equal(seen[2::5, 2::5], want)
    without = next(video_frames(*rollout("finished", None, False), VideoOptions((480, 270), 5)))
    assert share(without.crop((320, 0, 480, 270)), colours.DRONE, 2) < 0.01  # the scene goes on


def test_what_stands_before_the_drone_is_not_painted():
    eye, drone = np.zeros(3), np.array([2.0, 0.0, 0.0])
    before = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 1.0]])
    faces = np.stack([before, before + [2.0, 0.0, 0.0], before * [3.0, 1.0, 1.0] - [1.5, 0, 0]])
    faces[2, 0, 0] = 2.5  # one corner beyond is enough
    assert _beyond(faces, eye, drone).tolist() == [False, True, True]


def test_bad_video_requests_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"\.avi.*\.mp4 or \.gif"):
        write_video(tmp_path / "a.avi", *rollout())
    with pytest.raises(ValueError, match="even"):
        write_video(tmp_path / "a.mp4", *rollout(), VideoOptions(size=(161, 96)))
    track, flight, result = rollout()
    alone = flight._replace(time_s=np.zeros(1))
    with pytest.raises(ValueError, match="1 usable rows"):
        write_video(tmp_path / "a.mp4", track, alone, result)
    assert not list(tmp_path.iterdir())


def test_painted_solids_stand_where_a_pinhole_puts_them_and_the_near_hides_the_far():
    view = look_at(np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.0]), 90.0, (200, 100))
    ahead = to_pixels(view, to_camera(view, np.array([[2.0, 0, 1], [2, 1, 1], [2, 0, 1.5]])))
    # Left (y > 0) is left of the middle and up is above it; at 90 deg, 2 m to 2 m is the edge.
    np.testing.assert_allclose(ahead, [[100, 50], [50, 50], [100, 25]], atol=1e-9)
    # A sheet of 2 m by 2 m that faces the eye, which is at smaller x.
    y0z0, y1z0, y1z1, y0z1 = ([0.0, y, z] for y, z in ((-1, 0), (1, 0), (1, 2), (-1, 2)))
    sheet = np.array([[y0z0, y1z1, y1z0], [y0z0, y0z1, y1z1]])
    far, near = sheet + [4.0, 0, 0], 0.5 * sheet + [2.0, 0, 0.5]
    red, blue = np.tile([[255.0, 0, 0]], (2, 1)), np.tile([[0.0, 0, 255]], (2, 1))
    both = Faces(np.concatenate([near, far]), np.concatenate([blue, red]))
    pixels = np.asarray(paint(view, both, NO_LINES)).astype(int)
    red_there = pixels[..., 0] > 1.5 * pixels[..., 2]
    blue_there = pixels[..., 2] > 1.5 * pixels[..., 0]
    assert blue_there[50, 100] and blue_there.sum() == pytest.approx(
        50 * 50, rel=0.07
    )  # edges are drawn, too
    assert red_there.sum() < 60  # the far sheet is exactly as large to the eye, and hidden
    behind = Faces(far[:, ::-1], red)
    assert not (np.asarray(paint(view, behind, NO_LINES)).astype(int)[..., 0] > 250).any()
    around = Faces(sheet * 0.1 + [-0.05, 0, 0.9], red)  # behind the eye
    paint(view, around, NO_LINES)


def test_solids_are_the_gates_bars_first_and_their_normals_point_out():
    track = small_track()
    solids = track_solids(track)
    assert [solid.gate for solid in solids] == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4 + [None] * 4
    for solid in solids:
        corners = solid.vertices[solid.faces]
        outward = corners.mean(axis=1) - solid.vertices.mean(axis=0)
        assert (np.einsum("fi,fi->f", flat_normals(corners), outward) > 0).all()
    vertices, faces = joined(solids[:4])
    np.testing.assert_array_equal(vertices[faces][:12], solids[0].vertices[solids[0].faces])
    assert len(faces) == 48 and faces.max() == len(vertices) - 1


@given(npst.arrays(np.float64, (30, 2), elements=st.floats(-10, 10, width=16)))
def test_outlines_are_the_convex_hulls(points):
    corners = outline(points)
    if len(np.unique(points, axis=0)) < 3 or np.linalg.matrix_rank(points - points[0]) < 2:
        assert len(corners) <= 2
        return
    hull = ConvexHull(points)
    assert {tuple(c) for c in corners} == {tuple(points[k]) for k in hull.vertices}
    x, y = corners.T
    area = 0.5 * np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)
    assert area == pytest.approx(hull.volume)


def test_the_synthetic_flight_is_consistent():
    _, flight, _ = rollout()
    up = quat_to_rot(flight.quat_wxyz)[..., 2]
    force = np.gradient(flight.vel_w, flight.time_s, axis=0) + [0, 0, 9.81]
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    assert np.median(np.einsum("ti,ti->t", up, force)) > 0.999
