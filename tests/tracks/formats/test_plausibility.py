"""Notes on probable mistakes in a track from a file."""

import math

import pytest

from tests.tracks.formats.test_custom import GATE, write
from tracks.families import make_track
from tracks.formats.custom import load_track
from tracks.formats.plausibility import track_notes


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GATE.replace("1.5]", "1500]") + GATE.replace("0, 1.5]", "4000, 1500]"), "4000 m apart"),
        (GATE.replace("1.0", "30.0").replace("1.5]", "40]"), "30 m wide"),
        (GATE + GATE, "gates 0 and 1 have the same place and direction"),
        (GATE + GATE.replace("0, 1.5]", "5, 1.5]\nyaw_deg = 1.5708"), "gate 1 has a yaw of 1.571"),
        (GATE.replace("1.5]", "150]") + GATE.replace("0, 1.5]", "400, 150]"), "centimetres"),
        (GATE + GATE.replace("[0, 0,", "[0.1, 0,"), "gates 0 and 1 are only 0.1 m apart"),
        (GATE.replace("1.5]", "1.5]\nyaw_deg = 90.0")
         + "[start]\nposition = [0, -3, 1.5]\nyaw_deg = 1.5708\n", "is start.yaw_deg in radians?"),
        (GATE.replace("1.5]", "1.5]\nyaw_deg = 180") + GATE.replace("[0, 0, 1.5]", "[5, 0, 1.5]")
         + "[start]\nposition = [-3, 0, 1.5]\n", "gate 0 faces against the path"),
        (GATE + '[[spheres]]\nname = "tree"\ncenter = [0, 0, 1.5]\nradius = 0.3\n',
         "'tree' is within 0.5 m in front of or behind the centre of gate 0"),
        (GATE + GATE.replace("0, 1.5]", "5, 1.5]") + GATE.replace("0, 1.5]", "5.9, 1.5]"),
         "'gate 1 frame' stands in the opening of gate 2"),
        (GATE + '[[boxes]]\ncenter = [-0.4, 0, 1.5]\nsize = [0.002, 1, 1]\n', "'box 0' is within"),
        (GATE + '[[boxes]]\ncenter = [2500, 0, 1]\nsize = [1, 1, 1]\n', "2.5e+03 m away from all"),
        (GATE + '[[boxes]]\ncenter = [50, 0, 0]\nsize = [60, 60, 60]\n', "is its file in metres?"),
        (GATE + "frame_width = 20.0\n", "with a frame of up to 20 m"),
        (GATE + "[start]\nposition = [-250, 0, 1.5]\n", "start and gates are up to 250 m apart"),
        (GATE + "[start]\nposition = [3, 0, 1.5]\n", "the start is behind gate 0"),
        (GATE + "[start]\nposition = [-3, 0, 1.5]\nyaw_deg = 180\n", "the start faces away"),
    ],
)  # fmt: skip
def test_probable_mistakes_in_a_track_are_noted(tmp_path, text, said):
    *others, note = track_notes("mine", load_track(write(tmp_path, text)))
    assert note.startswith("mine: ") and said in note
    assert all("not along the path" in other for other in others)


PLACES, YAWS = ([0, 0, 1.3], [5, 1, 1.5], [9, 4, 1.3], [9, 9, 1.5]), (0.0, 15.0, 60.0, 100.0)

LINE = [[5 * k, 0, 1.5] for k in range(8)], [0.0] * 8
OVAL = (
    [[8 * math.sin(k * math.pi / 4), -8 * math.cos(k * math.pi / 4), 1.5] for k in range(8)],
    [45.0 * k for k in range(8)],
)


@pytest.mark.parametrize(
    ("places", "yaws", "said"),
    [
        (PLACES, YAWS, None),
        (PLACES, [yaw + 90.0 for yaw in YAWS], "with all yaws turned by -90 deg 0.9"),
        (PLACES, [-yaw for yaw in YAWS], "with the opposite sign of all yaws 0.9"),
        (PLACES, [0.0, 0.26, 1.05, 1.75], "with yaws in radians 0.9"),
        ([PLACES[k] for k in (0, 2, 1, 3)], [YAWS[k] for k in (0, 2, 1, 3)], "check the order"),
        *(
            (
                places,
                [yaw + turn * (k == gate) for k, yaw in enumerate(yaws)],
                f"gate {gate} {said}",
            )
            for places, yaws, gates, turn, said in (
                (PLACES, YAWS, range(4), 180.0, "faces against"),
                (*LINE, (0, 3, 7), 180.0, "faces against"),
                (*LINE, (0, 3, 7), 90.0, "faces across"),
                (*LINE, (0, 3, 7), -90.0, "faces across"),
                (*OVAL, (0, 3, 7), 180.0, "faces against"),
                (*OVAL, (3,), 90.0, "faces across"),
            )
            for gate in gates
        ),
        (*LINE, None),
        (*OVAL, None),
        ([*LINE[0][:3], [10, 0, 4.5]], [0.0, 0.0, 0.0, 180.0], None),  # up, and back above
    ],
)
def test_gates_that_do_not_face_along_the_path_are_noted(tmp_path, places, yaws, said):
    gates = (
        GATE.replace("[0, 0, 1.5]", f"{place}\nyaw_deg = {yaw}")
        for place, yaw in zip(places, yaws, strict=True)
    )
    notes = track_notes("mine", load_track(write(tmp_path, "".join(gates))))
    assert len(notes) == (said is not None) and (said is None or said in notes[0])


@pytest.mark.parametrize("family", ["zigzag", "circular", "ellipse", "random"])
def test_tracks_of_the_families_face_along_their_path(family):
    for level in (0, 5, 9):
        for seed in range(3):
            notes = track_notes("one", make_track(family, level, seed))
            assert not [note for note in notes if "the path" in note]


def test_a_second_lap_through_the_same_gates_is_no_mistake(tmp_path):
    lap = GATE + GATE.replace("0, 1.5]", "5, 1.5]")
    assert not track_notes("mine", load_track(write(tmp_path, lap + lap)))
    # Neither is a plate that can be flown round, nor a large floor.
    plate = "[[boxes]]\ncenter = [-0.7, 0, 1.5]\nsize = [0.1, 0.5, 0.5]\n"
    floor = "[[boxes]]\ncenter = [0, 0, 0.05]\nsize = [300, 300, 0.1]\nyaw_deg = 3600\n"
    assert not track_notes("mine", load_track(write(tmp_path, lap + plate + floor)))
