"""Write a track file with gates, a pole and a mesh, draw the track, and fly it.

tracks/examples/yard.toml shows every key of such a file. Run: python
examples/own_track.py [FOLDER]; then `suite eval --track FOLDER/course.toml`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh

from eval.view.picture import write_picture
from suite import evaluate_policy, load_track

COURSE = """
[[gates]]                  # in flight order; metres, degrees, world z is up
center = [3.0, 0.0, 1.4]
width = 1.1
height = 1.1

[[gates]]
center = [8.0, 1.5, 1.6]
yaw_deg = 20.0             # of the gate's x axis, the direction of flight
radius = 0.6               # a round opening

[[cylinders]]
name = "pole"
center = [5.5, 2.4, 1.5]
radius = 0.15
length = 3.0

[[meshes]]                 # any file that trimesh reads; connected parts must be convex
name = "roof"
file = "roof.stl"          # in the folder of this file
position = [5.5, -2.0, 0.0]
yaw_deg = 30.0
"""


def main(folder: Path) -> None:
    """Write course.toml, roof.stl and course.png to `folder`, and fly the track once."""
    folder.mkdir(parents=True, exist_ok=True)
    corners = [(x, y, 0.0) for x in (-1, 1) for y in (-0.5, 0.5)] + [(-1, 0, 1.2), (1, 0, 1.2)]
    trimesh.convex.convex_hull(np.array(corners)).export(folder / "roof.stl")
    path = folder / "course.toml"
    path.write_text(COURSE, encoding="utf-8")

    track = load_track(path)
    print(f"{track.family}: {len(track.scene.gates.center_w)} gates; solids: {set(track.names)}")
    write_picture(folder / "course.png", track)
    print(f"written: {path} and {folder / 'course.png'}")
    (result,) = evaluate_policy("race", track=track, trials=1, workers=1)
    print(f"{result.gates_passed} gates, {result.ending} after {result.time_s:.1f} s")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    main(Path(arguments[0]) if arguments else Path(tempfile.mkdtemp()))
