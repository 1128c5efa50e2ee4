"""The camera's rays, and scenes padded to a common size."""

import numpy as np
import pytest

from tracks.families import make_track
from tracks.geometry.camera import Camera, optical_axis_b, pixel_rays_b
from tracks.geometry.scene import PARKED_Z, counts, pad, stack


def test_rays_fill_the_field_of_view_and_measure_depth_along_the_axis():
    camera = Camera(pitch_deg=20.0, fov_deg=(90.0, 60.0), width=8, height=6)
    rays = pixel_rays_b(camera).reshape(6, 8, 3)
    np.testing.assert_allclose(rays @ optical_axis_b(camera), 1.0, atol=1e-12)
    # The outermost pixel's centre is half a pixel inside the edge.
    assert rays[0, 0, 1] == pytest.approx(np.tan(np.pi / 4) * 7 / 8)
    assert rays[0, 0, 2] > rays[-1, 0, 2], "the first row looks up"
    assert rays[0, 0, 1] > rays[0, -1, 1], "the first column looks left"


def test_padding_is_out_of_reach_and_keeps_what_is_there():
    scene = make_track("ellipse", 9, 1).scene
    have = counts(scene)
    more = have._replace(boxes=have.boxes + 3, spheres=have.spheres + 2, triangles=1)
    padded = pad(scene, more)
    assert counts(padded) == more
    np.testing.assert_array_equal(padded.boxes.center_w[: have.boxes], scene.boxes.center_w)
    assert (padded.boxes.center_w[have.boxes :, 2] == PARKED_Z).all()
    assert (padded.triangles[..., 2] <= PARKED_Z).all()
    with pytest.raises(ValueError, match=f"scene has {have.boxes} boxes, more than the 1"):
        pad(scene, have._replace(boxes=1))


def test_stacked_scenes_have_a_leading_axis():
    scenes = [make_track("zigzag", 0, seed).scene for seed in (1, 2)]
    most = counts(scenes[0])._replace(boxes=80, cylinders=20, capsules=20, spheres=20)
    both = stack(scenes, most)
    assert both.boxes.center_w.shape == (2, 80, 3) and both.gates.center_w.shape[0] == 2
    assert both.boxes.center_w.dtype == np.float32
