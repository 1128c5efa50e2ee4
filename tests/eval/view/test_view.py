"""Pictures and videos show track, path, gates and end; solids are as a pinhole camera sees them."""

import subprocess
from dataclasses import replace
from itertools import islice

import imageio_ffmpeg
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from PIL import Image, ImageSequence
from scipy.spatial import ConvexHull

from eval.view import colours, scene3d
from eval.view.chase import _not_between
from eval.view.picture import write_grid, write_picture
from eval.view.recording import Drone, write_recording
from eval.view.scene3d import Faces, Lines, divide_faces, look_at, paint
from eval.view.solids import flat_normals, join_solids, outline, track_solids
from eval.view.video import DEPTH_RANGE_M, VideoOptions, frame_times, video_frames, write_video
from eval.view.video_file import write_video_file
from tests.support.flights import rollout, small_track
from tests.support.marks import more
from tests.support.pixels import opened, share
from tests.support.recordings import columns
from tracks.geometry.camera import Camera

SMALL = VideoOptions(size=(160, 96), fps=10, hold_s=0.3)


@pytest.mark.extended
def test_a_diverged_flight_can_still_be_seen(tmp_path):
    track, flight, result = rollout("finished", 1.5)
    pos, vel = flight.pos_w.copy(), flight.vel_w.copy()
    pos[-3:], vel[-2:] = np.nan, np.nan
    lost = flight._replace(pos_w=pos, vel_w=vel)
    result = result._replace(ended_by="diverged")
    write_recording(tmp_path / "a.rrd", [(track, lost, result)], Drone(camera=Camera(pitch_deg=0)))
    write_picture(tmp_path / "a.png", track, lost, result)
    write_video(tmp_path / "a.gif", track, lost._replace(depth_m=None), result, SMALL)
    strips = columns(tmp_path / "a.rrd")["/trial_0/world/path", "LineStrips3D:strips"][1][0]
    assert len(strips) == len(pos) - 4


@pytest.mark.extended
def test_a_trial_without_a_row_can_still_be_seen(tmp_path):
    track, flight, result = rollout()
    arrays = {name: getattr(flight, name)[:0] for name in type(flight)._fields[:-2]}
    none = track, flight._replace(**arrays), result
    write_picture(tmp_path / "a.png", *none)
    write_grid(tmp_path / "b.png", [none])
    write_recording(tmp_path / "a.rrd", [none])
    assert ("/trial_0/world/end", "Points3D:positions") in columns(tmp_path / "a.rrd")
    assert share(opened(tmp_path / "a.png"), colours.PASSED) > 1e-3


def test_the_fastest_and_the_nearest_have_the_ends_of_their_colours():
    assert colours.hex_text((1, 16, 255)) == "#0110ff"
    speed = np.array([0.0, 4.0, 9.0])
    slow, fast, faster = colours.speed_colours(speed, 4.0).tolist()
    assert fast == faster != slow
    assert colours.top_speed(np.array([0.2, np.nan])) == 1.0
    assert colours.top_speed(np.array([2.5, np.nan])) == 2.5
    near, far = colours.depth_colours(np.array([0.0, 10.0]), 10.0).astype(int)
    assert near[0] > near[2] and far[2] > far[0]
    np.testing.assert_allclose(colours.brightness(colours.LIGHT_W), 1.0)
    np.testing.assert_allclose(colours.brightness(-colours.LIGHT_W), 0.44)


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


def test_a_name_with_dollar_signs_is_a_name(tmp_path):
    track, flight, result = rollout()
    odd = (replace(track, family="a$x^{$"), flight, result._replace(policy="b$\\foo$"))
    write_grid(tmp_path / "grid.png", [odd])
    assert opened(tmp_path / "grid.png").size[0] > 300


def test_bad_picture_requests_are_refused(tmp_path):
    for name in ("trial", "trial.xyz"):
        with pytest.raises(ValueError, match="a picture ends in .png, .pdf or .svg"):
            write_picture(tmp_path / name, small_track())
    with pytest.raises(ValueError, match="track is 'zigzag', allowed is a Track"):
        write_picture(tmp_path / "a.png", "zigzag")  # type: ignore[arg-type]
    assert not list(tmp_path.iterdir())


@pytest.mark.extended
def test_a_grid_has_a_panel_a_trial(tmp_path):
    trials = [rollout(), rollout("collision", 1.5, False), (small_track(4, seed=2), None, None)]
    write_grid(tmp_path / "one.png", trials[:1])
    write_grid(tmp_path / "three.png", trials, columns=2)
    one, three = opened(tmp_path / "one.png"), opened(tmp_path / "three.png")
    assert three.size[0] > 1.6 * one.size[0] and three.size[1] > 1.6 * one.size[1]
    with pytest.raises(ValueError, match="at least one trial"):
        write_grid(tmp_path / "none.png", [])


NO_LINES = Lines(np.zeros((0, 2, 3)), np.zeros((0, 3)), 0.01)


def test_painted_solids_stand_where_a_pinhole_puts_them_and_the_near_hides_the_far():
    view = look_at(np.array([0.0, 0.0, 1.0]), np.array([5.0, 0.0, 1.0]), 90.0, (200, 100))
    ahead = scene3d.to_pixels(
        view, scene3d.to_camera(view, np.array([[2.0, 0, 1], [2, 1, 1], [2, 0, 1.5]]))
    )
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
    # Edges are drawn, too.
    assert blue_there[50, 100] and blue_there.sum() == pytest.approx(50 * 50, rel=0.07)
    assert red_there.sum() < 60  # the far sheet is exactly as large to the eye, and hidden
    behind = Faces(far[:, ::-1], red)
    assert not (np.asarray(paint(view, behind, NO_LINES)).astype(int)[..., 0] > 250).any()
    around = Faces(sheet * 0.1 + [-0.05, 0, 0.9], red)  # behind the eye
    paint(view, around, NO_LINES)


def sheet_and_box():
    """A floor of 30 m by 30 m, and a box of 1 m on it, 8 m ahead: what faces the eye of it."""
    x0, x1, y0, y1 = -15.0, 15.0, -15.0, 15.0
    floor = [[[x0, y0, 0], [x1, y0, 0], [x1, y1, 0]], [[x0, y0, 0], [x1, y1, 0], [x0, y1, 0]]]
    front = [[[8, 1, 0], [8, -1, 1], [8, 1, 1]], [[8, 1, 0], [8, -1, 0], [8, -1, 1]]]
    return np.array(floor, float), np.array(front, float)


def test_what_is_cut_up_covers_the_same_and_knows_whose_it_was():
    floor, front = sheet_and_box()
    corners = np.concatenate([front, floor])
    parts, whose = divide_faces(corners)
    side = np.linalg.norm(parts - np.roll(parts, -1, axis=1), axis=-1)
    assert side.max() <= scene3d.LONGEST_M and (whose == 0).sum() >= 1

    def areas(triangles):
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        return cross / 2  # with its direction: the winding stays

    for number, whole in enumerate(areas(corners)):
        np.testing.assert_allclose(areas(parts[whose == number]).sum(0), whole, atol=1e-9)
    assert len(divide_faces(1e4 * floor)[0]) <= scene3d.MOST_FACES


def test_solids_are_the_gates_bars_first_and_their_normals_point_out():
    track = small_track()
    solids = track_solids(track)
    assert [solid.gate for solid in solids] == [0] * 4 + [1] * 4 + [2] * 4 + [3] * 4 + [None] * 4
    for solid in solids:
        corners = solid.vertices[solid.faces]
        outward = corners.mean(axis=1) - solid.vertices.mean(axis=0)
        assert (np.einsum("fi,fi->f", flat_normals(corners), outward) > 0).all()
    vertices, faces = join_solids(solids[:4])
    np.testing.assert_array_equal(vertices[faces][:12], solids[0].vertices[solids[0].faces])
    assert len(faces) == 48 and faces.max() == len(vertices) - 1


@settings(max_examples=20)
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


def test_the_video_shows_drone_depth_and_gates():
    track, flight, result = rollout()
    frames = list(video_frames(track, flight, result, VideoOptions((480, 270), 4, hold_s=0.2)))
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
    # A frame between the second decision and the next row shows the second image.
    _, frame = islice(video_frames(track, flight, result, VideoOptions((480, 270), 36)), 2)
    want = colours.depth_colours(flight.depth_m[1], DEPTH_RANGE_M)
    np.testing.assert_array_equal(np.asarray(frame)[77:195:5, 322:480:5], want)
    without = next(video_frames(*rollout("finished", None, False), VideoOptions((480, 270), 5)))
    assert share(without.crop((320, 0, 480, 270)), colours.DRONE, 2) < 0.01  # the scene goes on


def test_what_stands_before_the_drone_is_not_painted():
    eye, drone = np.zeros(3), np.array([2.0, 0.0, 0.0])
    before = np.array([[1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 0.0, 1.0]])
    faces = np.stack([before, before + [2.0, 0.0, 0.0], before * [3.0, 1.0, 1.0] - [1.5, 0, 0]])
    faces[2, 0, 0] = 2.5  # one corner beyond is enough
    assert _not_between(faces, eye, drone).tolist() == [False, True, True]


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


@pytest.mark.parametrize("kind", ["mp4", more("gif")])
def test_a_video_plays_the_whole_flight(tmp_path, kind):
    done = []
    path = tmp_path / f"a.{kind}"
    track, flight, result = rollout("finished", 1.5)
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
    decoder = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", path, *"-f rawvideo -pix_fmt rgb24 -".split()]
    done = subprocess.run(decoder, capture_output=True, check=True)
    stream = done.stderr.decode().split("Output #0")[0]
    assert "h264" in stream and "yuv420p" in stream and "160x96" in stream and "10 fps" in stream
    frames = np.frombuffer(done.stdout, np.uint8).reshape(-1, 96, 160, 3)
    assert len(frames) == expected
    painted = list(video_frames(track, flight, result, SMALL))
    for number in (0, expected // 2, expected - 1):
        error = np.abs(frames[number].astype(int) - np.asarray(painted[number]).astype(int))
        assert error.mean() < 6


def test_a_gif_is_as_long_as_its_frames_at_any_rate(tmp_path):
    frames = [Image.new("RGB", (8, 8), (20 * k, 0, 0)) for k in range(12)]
    write_video_file(tmp_path / "a.gif", frames, (8, 8), 12)
    with Image.open(tmp_path / "a.gif") as video:
        lasting = [frame.info["duration"] for frame in ImageSequence.Iterator(video)]
    assert sum(lasting) == 1000


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
