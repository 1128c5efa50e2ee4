"""Small tracks made by hand, for tests of the judge."""

import numpy as np

from eval.judging.judge import JudgeOptions
from eval.worlds.trial import TrialSpec
from tests.support.reference import fly
from tracks.geometry.scene import Boxes, Gates, Rods, Scene, Spheres
from tracks.track import Track

IN_CONTACT = """
[start]
position = [0.0, 0.0, 0.02]
[[gates]]
center = [5.0, 0.0, 1.3]
width = 1.0
height = 1.0
"""
"""A track file whose start is too close to the ground."""
ONE_GATE = IN_CONTACT.replace("0.02", "1.3")
"""The same track with a start in the air; it is read faster than one with a mesh."""


def straight(distances=(2.0, 4.0), wall_at=None, height=1.5, name="straight"):
    """Return gates without frames on the x axis, and a wall across it."""
    n = len(distances)
    half = 0.5
    opening = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
    gates = Gates(
        np.array([[x, 0.0, height] for x in distances]),
        np.tile(np.eye(3), (n, 1, 1)),
        np.tile(opening, (n, 1, 1)),
        np.full(n, 0.2),
        np.full(n, 0.05),
    )
    walls = [] if wall_at is None else [[wall_at, 0.0, height]]
    boxes = Boxes(
        np.array(walls).reshape(-1, 3),
        np.tile(np.eye(3), (len(walls), 1, 1)),
        np.tile([0.05, 1.0, 1.0], (len(walls), 1)),
    )
    none = np.zeros((0, 3)), np.zeros(0)
    rods, spheres = Rods(none[0], *none, none[1]), Spheres(*none)
    scene = Scene(gates, boxes, rods, rods, spheres, np.zeros((0, 3, 3)))
    names = ("the wall",) * len(walls)
    return Track(name, 0, 0, 0.0, scene, np.array([0.0, 0.0, height]), 0.0, names)


def fly_on(policy, *tracks, vehicle, world="mujoco", seeds=(0,), record=None, **options):
    """Return the results and flights of a policy on given tracks, in order."""
    named, flights = {track.family: track for track in tracks}, {}
    trials = [TrialSpec(name, 0, seed) for name in named for seed in seeds]
    results = fly(
        policy, trials, vehicle, world, JudgeOptions(**options),
        lambda result, flight: flights.update({result.trial: flight}), record, named,
    )  # fmt: skip
    return results, [flights[trial] for trial in trials]


def end_of(result):
    """Return the position (x, y, z) at the end of a trial [m]."""
    return [result.pos_x, result.pos_y, result.pos_z]
