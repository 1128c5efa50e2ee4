"""Which errors are messages to a person, and which are bugs."""

import errno
import multiprocessing
import os
import traceback
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

from suite.common.errors import FAILED, UNUSABLE, explain
from tracks.geometry.scene import Boxes, Counts, Gates, Scene, Spheres, no_rods, pad


def _pad_one_box(to_boxes, center_w):
    none = np.zeros((0, 3))
    gates = Gates(none, np.zeros((0, 3, 3)), np.zeros((0, 4, 2)), np.zeros(0), np.zeros(0))
    boxes = Boxes(np.array([center_w]), np.zeros((1, 3, 3)), np.ones((1, 3)))
    spheres = Spheres(none, np.zeros(0))
    scene = Scene(gates, boxes, no_rods(), no_rods(), spheres, np.zeros((0, 3, 3)))
    return pad(scene, Counts(to_boxes, 0, 0, 0))


def test_numpys_value_error_is_a_bug_and_one_raised_on_purpose_in_a_worker_process_a_message():
    with pytest.raises(ValueError) as met:
        _pad_one_box(2, [0.0, 0.0])
    frames = traceback.extract_tb(met.value.__traceback__)
    assert frames[-1].filename.endswith("scene.py"), "the case is one with no frame of numpy's"
    assert explain(met.value) is None
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        with pytest.raises(ValueError, match="more than the 0") as met:
            list(pool.map(_pad_one_box, [0], [[0.0, 0.0, 0.0]]))
    assert (explain(met.value) or (None,))[0] == UNUSABLE


def test_what_the_system_refuses_is_one_line_with_the_file_and_a_mistake_of_ours_is_a_bug():
    usage = ("EROFS", "ENAMETOOLONG", "ELOOP", "ENXIO", "EACCES")
    trouble = ("ENOSPC", "EIO", "EMFILE", "EFBIG", "ESTALE", "ENOTCONN", "EREMOTEIO")
    for name in (*usage, *trouble):
        number = getattr(errno, name)
        code, said = explain(OSError(number, os.strerror(number), "runs/x")) or (None, "")
        assert code == (UNUSABLE if name in usage else FAILED) and "runs/x" in said, name
        assert name == "ENOSPC" or os.strerror(number).lower() in said
    assert explain(OSError(errno.EBADF, "Bad file descriptor")) is None
    code, said = explain(FileExistsError(errno.EEXIST, "File exists", "runs/x")) or (None, "")
    assert code == UNUSABLE and "a file exists: runs/x; give another --out" in said


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("Unable to initialize backend 'cuda': no device\nmore\nlines", "JAX_PLATFORMS is 'cuda'"),
        ("invalid value for environment variable MUJOCO_GL: glx2", "MUJOCO_GL: glx2; unset it"),
    ],
)
def test_a_platform_or_display_that_is_not_there_is_one_line(words, said, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "cuda")
    code, text = explain(RuntimeError(words)) or (None, "")
    assert code == UNUSABLE and said in text and "\n" not in text


@pytest.mark.parametrize(("name", "words"), [("x" * 10_000, "xxx"), ("a\0b", "NUL")])
def test_a_name_that_cannot_be_is_a_short_message(name, words):
    with pytest.raises((OSError, ValueError)) as met:
        open(name)
    code, said = explain(met.value) or (None, "")
    assert code == UNUSABLE and words in said and len(said) < 400
