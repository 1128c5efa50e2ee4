"""Work for other processes: in a module of its own, as each of them imports it."""

import os
import time

import numpy as np

from suite.common.console import Silent
from suite.common.errors import WorkFailed
from tracks.geometry.scene import Boxes, Counts, Gates, Rods, Scene, Spheres, pad


def double(job, console):
    """Return twice the task, and the cores of this process; show progress before and after."""
    assert type(console) is Silent
    with console.progress("halves", 10) as update:
        update(5)
        # A process returns messages five times a second.
        time.sleep(0.3)
        update(9)
    return 2 * job.task, sorted(os.sched_getaffinity(0))


def die(job, console):
    os._exit(7)


def diverge(job, console):
    raise WorkFailed(f"training {job.task} diverged")


def pad_one_box(to_boxes, center_w):
    """Return a scene with one box, padded to so many."""
    none = np.zeros((0, 3))
    gates = Gates(none, np.zeros((0, 3, 3)), np.zeros((0, 4, 2)), np.zeros(0), np.zeros(0))
    boxes = Boxes(np.array([center_w]), np.zeros((1, 3, 3)), np.ones((1, 3)))
    rods, spheres = Rods(none, none, np.zeros(0), np.zeros(0)), Spheres(none, np.zeros(0))
    scene = Scene(gates, boxes, rods, rods, spheres, np.zeros((0, 3, 3)))
    return pad(scene, Counts(to_boxes, 0, 0, 0))
