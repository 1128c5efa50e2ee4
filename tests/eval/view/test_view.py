"""Views of flights that went wrong, and the colours that all views share."""

import numpy as np

from eval.view import colours
from eval.view.picture import write_grid, write_picture
from eval.view.recording import Drone, write_recording
from eval.view.video import (
    VideoOptions,
    write_video,
)
from tests.support.flights import rollout
from tests.support.pixels import opened, share
from tests.support.recordings import columns
from tracks.geometry.camera import Camera
from tracks.geometry.rotation import quat_to_rot

SMALL = VideoOptions(size=(160, 96), fps=10, hold_s=0.3)


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


def test_a_trial_without_a_row_can_still_be_seen(tmp_path):
    track, flight, result = rollout()
    arrays = {name: getattr(flight, name)[:0] for name in type(flight)._fields[:-2]}
    write_picture(tmp_path / "a.png", track, flight._replace(**arrays), result)
    write_grid(tmp_path / "b.png", [(track, flight._replace(**arrays), result)])
    write_recording(tmp_path / "a.rrd", [(track, flight._replace(**arrays), result)])
    assert ("/trial_0/world/end", "Points3D:positions") in columns(tmp_path / "a.rrd")
    assert share(opened(tmp_path / "a.png"), colours.PASSED) > 1e-3


def test_the_synthetic_flight_is_consistent():
    _, flight, _ = rollout()
    up = quat_to_rot(flight.quat_wxyz)[..., 2]
    force = np.gradient(flight.vel_w, flight.time_s, axis=0) + [0, 0, 9.81]
    force /= np.linalg.norm(force, axis=1, keepdims=True)
    assert np.median(np.einsum("ti,ti->t", up, force)) > 0.999


def test_the_fastest_and_the_nearest_have_the_ends_of_their_colours():
    assert colours.hexed((1, 16, 255)) == "#0110ff"
    speed = np.array([0.0, 4.0, 9.0])
    slow, fast, faster = colours.speed_colours(speed, 4.0).tolist()
    assert fast == faster != slow
    assert colours.top_speed(np.array([0.2, np.nan])) == 1.0
    assert colours.top_speed(np.array([2.5, np.nan])) == 2.5
    near, far = colours.depth_colours(np.array([0.0, 10.0]), 10.0).astype(int)
    assert near[0] > near[2] and far[2] > far[0]
    np.testing.assert_allclose(colours.brightness(colours.LIGHT_W), 1.0)
    np.testing.assert_allclose(colours.brightness(-colours.LIGHT_W), 0.44)
