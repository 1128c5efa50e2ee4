"""The camera's rays, and scenes padded to a common size."""

import numpy as np
import pytest

from tracks.families import make_track
from tracks.geometry.camera import Camera, cast_rays_b, nearest, optical_axis_b, pixel_rays_b
from tracks.geometry.scene import PARKED_Z, counts, pad, stack


def test_rays_fill_the_field_of_view_and_measure_depth_along_the_axis():
    camera = Camera(pitch_deg=20.0, fov_deg=(90.0, 60.0), width=8, height=6)
    rays = pixel_rays_b(camera).reshape(6, 8, 3)
    np.testing.assert_allclose(rays @ optical_axis_b(camera), 1.0, atol=1e-12)
    # The outermost pixel's centre is half a pixel inside the edge.
    assert rays[0, 0, 1] == pytest.approx(np.tan(np.pi / 4) * 7 / 8)
    assert rays[0, 0, 2] > rays[-1, 0, 2], "the first row looks up"
    assert rays[0, 0, 1] > rays[0, -1, 1], "the first column looks left"


def test_several_rays_a_pixel_share_it_evenly_and_the_nearest_counts():
    camera = Camera(fov_deg=(90.0, 60.0), width=8, height=6, rays=3)
    rays = cast_rays_b(camera)
    parts = rays.reshape(9, 6 * 8, 3)
    np.testing.assert_allclose(parts.mean(0), pixel_rays_b(camera), atol=1e-12)
    finer = pixel_rays_b(Camera(fov_deg=(90.0, 60.0), width=24, height=18)).reshape(18, 24, 3)
    # The last part of the pixel in row 1, column 2 is the finer image's row 5, column 8.
    np.testing.assert_allclose(rays.reshape(9, 6, 8, 3)[8, 1, 2], finer[5, 8], atol=1e-12)

    depth_m = np.full((2, 9 * 6 * 8), 10.0)
    depth_m[1, 4 * 48 + 1 * 8 + 2] = 3.0
    image = nearest(camera, depth_m)
    assert image.shape == (2, 6, 8) and image[1, 1, 2] == 3.0
    assert (image < 10.0).sum() == 1


def test_one_ray_a_pixel_goes_through_its_centre():
    np.testing.assert_array_equal(cast_rays_b(Camera()), pixel_rays_b(Camera()))


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
