"""Which errors are messages to a person, and which are bugs."""

import errno
import multiprocessing
import os
import traceback
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from suite.common.errors import explain
from tracks.geometry.scene import Boxes, Counts, Gates, Scene, Spheres, no_rods, pad


def _pad_one_box(to_boxes, center_w):
    none = np.zeros((0, 3))
    gates = Gates(none, np.zeros((0, 3, 3)), np.zeros((0, 4, 2)), np.zeros(0), np.zeros(0))
    boxes = Boxes(np.array([center_w]), np.zeros((1, 3, 3)), np.ones((1, 3)))
    spheres = Spheres(none, np.zeros(0))
    scene = Scene(gates, boxes, no_rods(), no_rods(), spheres, np.zeros((0, 3, 3)))
    return pad(scene, Counts(to_boxes, 0, 0, 0))


def test_a_value_error_that_numpy_throws_in_our_rooms_is_a_bug():
    with pytest.raises(ValueError) as met:
        _pad_one_box(2, [0.0, 0.0])
    frames = traceback.extract_tb(met.value.__traceback__)
    assert frames[-1].filename.endswith("scene.py"), "the case is one with no frame of numpy's"
    assert explain(met.value) is None


def test_an_error_raised_on_purpose_in_a_worker_process_is_a_message():
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        with pytest.raises(ValueError, match="more than the 0") as met:
            list(pool.map(_pad_one_box, [0], [[0.0, 0.0, 0.0]]))
    explained = explain(met.value)
    assert explained is not None and explained[0] == 2


def test_what_the_system_refuses_is_one_line_with_the_file():
    usage = ("EROFS", "ENAMETOOLONG", "ELOOP", "ENXIO", "EACCES")
    for name in (*usage, "ENOSPC", "EIO", "EMFILE"):
        number = getattr(errno, name)
        explained = explain(OSError(number, os.strerror(number), "runs/x"))
        assert explained is not None and explained[0] == (2 if name in usage else 1), name
        assert "runs/x" in explained[1]


@pytest.mark.parametrize(("name", "words"), [("x" * 10_000, "xxx"), ("a\0b", "NUL")])
def test_a_name_that_cannot_be_is_a_short_message(name, words):
    with pytest.raises((OSError, ValueError)) as met:
        open(name)
    explained = explain(met.value)
    assert (
        explained is not None
        and explained[0] == 2
        and words in explained[1]
        and len(explained[1]) < 400
    )
