"""A saved track comes back as it was."""

import numpy as np
import pytest

from tracks.families import FAMILIES, make_track
from tracks.formats.custom import load_track
from tracks.formats.custom_save import save_track


def leaves(scene):
    return [a for part in scene for a in (part if isinstance(part, tuple) else (part,))]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_saved_track_comes_back(tmp_path, family):
    track = make_track(family, 8, 2)
    save_track(track, tmp_path / "copy.toml")
    again = load_track(tmp_path / "copy.toml")
    assert again.names == track.names and again.family == family
    assert again.start_yaw == pytest.approx(track.start_yaw)
    assert np.array_equal(again.start_pos_w, track.start_pos_w)
    for mine, theirs in zip(leaves(track.scene), leaves(again.scene), strict=True):
        assert np.allclose(mine, theirs, rtol=0, atol=1e-9)
    assert [path.name for path in tmp_path.iterdir()] == ["copy.toml"]


def test_meshes_and_polygons_come_back(tmp_path, root):
    track = load_track(root / "tracks" / "examples" / "yard.toml")
    save_track(track, tmp_path / "yard.toml")
    again = load_track(tmp_path / "yard.toml")
    assert again.names == track.names and again.mesh_sizes == track.mesh_sizes
    for mine, theirs in zip(leaves(track.scene)[:-1], leaves(again.scene)[:-1], strict=True):
        assert np.allclose(mine, theirs, rtol=0, atol=1e-9)

    middles = [np.sort(t.scene.triangles.mean(1), axis=0) for t in (track, again)]
    assert np.allclose(*middles, rtol=0, atol=1e-7)


def test_names_come_back_whatever_they_hold(tmp_path):
    gate = "[[gates]]\ncenter = [0, 0, 1.5]\nwidth = 1.0\nheight = 1.0\n"
    box = gate + '[[boxes]]\nname = "a \u00e9 \\\\ \\" b"\ncenter = [0, 0, 9]\nsize = [1, 1, 1]\n'
    (tmp_path / "a.toml").write_text('name = "x\\u007fy"\n' + box, encoding="utf-8")
    track = load_track(tmp_path / "a.toml")
    save_track(track, tmp_path / "b.toml")
    again = load_track(tmp_path / "b.toml")
    assert (again.family, again.names) == (track.family, track.names)
