"""Pictures show track, path, gates and end, also of flights that went wrong."""

from dataclasses import replace

import numpy as np
import pytest

from eval.view import colours
from eval.view.picture import write_grid, write_picture
from eval.view.recording import Drone, write_recording
from eval.view.video import VideoOptions, write_video
from tests.support.flights import rollout, small_track
from tests.support.pixels import opened, share
from tests.support.recordings import columns
from tracks.geometry.camera import Camera

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
    write_picture(tmp_path / "one.png", *odd)
    write_grid(tmp_path / "grid.png", [odd])
    assert opened(tmp_path / "one.png").size[0] > 600


def test_a_grid_has_a_panel_a_trial(tmp_path):
    trials = [rollout(), rollout("collision", 1.5, False), (small_track(6, seed=2), None, None)]
    write_grid(tmp_path / "one.png", trials[:1])
    write_grid(tmp_path / "three.png", trials, columns=2)
    one, three = opened(tmp_path / "one.png"), opened(tmp_path / "three.png")
    assert three.size[0] > 1.6 * one.size[0] and three.size[1] > 1.6 * one.size[1]
    with pytest.raises(ValueError, match="at least one trial"):
        write_grid(tmp_path / "none.png", [])
