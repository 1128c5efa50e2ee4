"""A track of another program is refused where no simulator can fly it, and probable mistakes."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import suite
from eval.worlds.engine import family_notes
from tracks.families import FAMILIES, make_track
from tracks.families.layout import Layout, build
from tracks.geometry.gates import square_gates
from tracks.geometry.obstacles import Obstacles
from tracks.geometry.scene import Boxes, Rods, Spheres

STEP = np.arange(4.0)
CENTERS = np.stack([5.0 * STEP, 0.0 * STEP, 1.0 + 0.0 * STEP], axis=-1)


def line(yaw: float = 0.0, centers: np.ndarray = CENTERS, side: float = 1.0) -> Layout:
    """Four gates in a line along x, without obstacles."""
    of_each = [np.full(4, number) for number in (yaw, side, 0.2, 0.05)]
    rods = Rods(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    boxes, spheres = Boxes(rods[0], np.zeros((0, 3, 3)), rods[0]), Spheres(rods[0], np.zeros(0))
    gates = square_gates(centers, *of_each)
    return build(gates, np.array([-2.5, 0.0, 1.0]), Obstacles(boxes, rods, rods, spheres, ()))


def gates(**changed: Any) -> Layout:
    layout = line()
    scene = layout.scene._replace(gates=layout.scene.gates._replace(**changed))
    return layout._replace(scene=scene)


def changed(**fields: Any) -> Callable[..., Layout]:
    return lambda d, rng: line()._replace(**fields)


@pytest.fixture
def family(monkeypatch):
    """Registers a function as the family `mine`."""

    def register(make):
        monkeypatch.setitem(FAMILIES._entries, "mine", make)
        monkeypatch.setitem(FAMILIES._values, "mine", make)

    return register


UNKNOWN = np.where(np.arange(4)[:, None] == 2, np.nan, CENTERS)
NAMES = line().names


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda d, rng: gates(center_w=UNKNOWN), "scene.gates.center_w is not finite"),
        (lambda d, rng: gates(center_w=CENTERS[:, :2]), "of shape (4, 2), allowed is of shape"),
        (lambda d, rng: gates(frame_width=0.2), "scene.gates.frame_width is a float"),
        (lambda d, rng: gates(frame_width=np.zeros(4)), "frame_width is 0 m, allowed is above 0"),
        (lambda d, rng: gates(rot_w=2.0 * line().scene.gates.rot_w), "rot_w is no rotation"),
        (lambda d, rng: gates(opening_g=line().scene.gates.opening_g[:, ::-1]), "of -1 m^2"),
        (lambda d, rng: line(side=1e-9), "scene.gates.opening_g is of"),
        (lambda d, rng: line(centers=CENTERS - [0, 0, 0.7]), "gate 0 is 0.2 m below the ground"),
        (changed(start_pos_w=np.array([0.0, np.nan, 1.0])), "start_pos_w is not finite"),
        (changed(start_pos_w=[-2.5, 0.0, 1.0]), "start_pos_w is a list"),
        (changed(start_pos_w=np.array([-2.5, 0.0, -1.0])), "allowed is above the ground"),
        (changed(start_yaw=np.nan), "start_yaw is not finite"),
        (changed(names=NAMES[:-1]), "names is without frames"),
        (changed(names=(*NAMES, "wall")), "names is 17 or not"),
        (lambda d, rng: line(centers=CENTERS + [0, np.random.normal(), 0]), "two different"),
    ],
)
def test_a_track_that_cannot_be_flown_is_refused(family, make, said):
    family(make)
    with pytest.raises(ValueError, match=f"'mine'.*{re.escape(said)}"):
        make_track("mine", 0, 0)


def test_a_family_with_wrong_yaws_gets_the_notes_of_a_track_file(family):
    vehicle = suite.load_vehicle("reference")
    family(lambda d, rng: line())
    assert family_notes("mine", 0, 0, vehicle) == []
    family(changed(start_pos_w=np.array([0.0, 0.5, 1.0])))  # in the frame of gate 0
    said = r"mine: at its start \[0.0, 0.5, 1.0\] the body of 'reference' .* touches gate 0 frame;"
    assert re.match(said, family_notes("mine", 0, 0, vehicle)[0])
    family(lambda d, rng: line(yaw=np.pi))
    assert "against the path" in family_notes("mine", 0, 0, vehicle)[0]
    family(lambda d, rng: line(side=0.1))
    assert "too small for the body" in family_notes("mine", 0, 0, vehicle)[-1]


def test_a_track_made_by_a_program_is_checked_before_it_is_flown(family):
    family(lambda d, rng: line())
    track = make_track("mine", 0, 0)
    track.start_pos_w[0] = np.nan
    with pytest.raises(ValueError, match="start_pos_w is not finite"):
        suite.evaluate_policy("race", track=track, trials=1)
