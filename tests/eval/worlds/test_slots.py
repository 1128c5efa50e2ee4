"""What a world with slots keeps for each."""

from dataclasses import replace

import numpy as np

from eval.worlds.slots import (
    GATES,
    GUSTS_AT_ONCE,
    Gusts,
    empty_course,
    fitting,
    generator_of,
    layout_of,
    noise_of,
    pad_gates,
)
from eval.worlds.trial import TrialSpec
from tests.support.courses import straight

TRIAL = TrialSpec("zigzag", 3, 7)


def test_a_layout_holds_every_track():
    layout = layout_of([straight(tuple(range(1, 12)))])
    assert layout.gates == 11 and layout.corners == 4
    assert layout.solids == layout_of([]).solids


def test_a_track_with_meshes_is_a_group_of_its_own():
    plain = straight((1.0, 2.0))
    tracks = {"a.toml": plain, "m.toml": replace(plain, mesh_sizes=(12,))}
    trials = [TRIAL._replace(track=name) for name in ("zigzag", "m.toml", "a.toml", "m.toml")]
    assert fitting(trials, tracks) == [[0, 2], [1, 3]]
    assert fitting([], {}) == []


def test_padding_repeats_the_last_gate():
    gates = straight((1.0, 2.0)).scene.gates
    padded = pad_gates(gates, 4, 6)
    np.testing.assert_array_equal(padded.center_w[:, 0], [1.0, 2.0, 2.0, 2.0])
    np.testing.assert_array_equal(padded.opening_g[:, 3:], padded.opening_g[:, 3:4].repeat(3, 1))


def test_an_empty_course_has_room_for_every_gate():
    course, layout = empty_course(3, layout_of([])), layout_of([])
    assert course.gates.opening_g.shape == (3, layout.gates, layout.corners, 2)
    assert np.isfinite(course.gates.rot_w).all() and course.count.tolist() == [1, 1, 1]


def test_a_trials_random_numbers_are_its_own_for_each_use():
    np.testing.assert_array_equal(noise_of(TRIAL, 5), noise_of(TRIAL, 9)[:5])
    others = TRIAL._replace(seed=8), TRIAL._replace(difficulty=4), TRIAL._replace(track="circular")
    for other in others:
        assert (noise_of(other, 5) != noise_of(TRIAL, 5)).all()
    here, there = (TRIAL._replace(track=f"{way}own.toml") for way in ("", "./courses/"))
    np.testing.assert_array_equal(noise_of(here, 5), noise_of(there, 5))
    assert generator_of(TRIAL, GATES).standard_normal() != noise_of(TRIAL, 1)[0, 0]


def test_gusts_are_drawn_as_the_flight_goes_on():
    gusts, whole = Gusts(TRIAL), noise_of(TRIAL, 4 * GUSTS_AT_ONCE)
    last = GUSTS_AT_ONCE - 1
    for step, count in ((0, 1), (1, 5), (last, 3), (3 * last, 2 * last), (2, 4)):
        wanted = whole[step : step + count]
        np.testing.assert_array_equal(gusts.at(step, count)[: len(wanted)], wanted)
    kept = Gusts(TRIAL)
    for step in range(0, 100 * GUSTS_AT_ONCE, 50):
        kept.at(step, 60)
    assert len(kept._rows) < 3 * GUSTS_AT_ONCE, "an hour's are not kept"
