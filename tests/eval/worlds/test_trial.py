"""The rules of a trial, state by state, and the data that batched simulators keep for each."""

from dataclasses import replace

import numpy as np
import pytest

from eval.quadrotor.plant import Motion, Wrench
from eval.worlds import slots, trial
from eval.worlds.slots import GUSTS_AT_ONCE, GustDraws, layout_of
from tests.support.courses import straight
from tracks.geometry.scene import Gates

DT = 0.002
GATES = straight((1.0, 2.0)).scene.gates


def judged(pos_w, before_w=None, passed=0, step=1, contact=False, diverged=False, rot_w=None):
    """Return the progress of a trial that moved from `before_w` to `pos_w` after `passed` gates."""
    pos_w = np.array([pos_w], float)
    course = trial.Course(Gates(*(field[None] for field in GATES)), np.array([2]))
    progress = trial.start_progress(pos_w if before_w is None else np.array([before_w], float))
    progress = progress._replace(gates=np.array([passed]), step=np.array([step]))
    rot_w = np.eye(3)[None] if rot_w is None else rot_w
    motion = Motion(pos_w, rot_w, np.array([[3.0, 4.0, 0.0]]), np.zeros((1, 3)))
    flags = np.array([contact]), np.array([diverged])
    return trial.judge_state(trial.Rules(), progress, course, DT, motion, *flags)


BEFORE, AFTER = (1.9, 0.0, 1.5), (2.1, 0.0, 1.5)


def test_the_last_gate_finishes_unless_something_is_hit_in_the_same_step():
    through = judged(AFTER, BEFORE, passed=1)
    assert (through.ended[0], through.gates[0], through.v_max[0]) == (trial.FINISHED, 2, 5.0)
    hit = judged(AFTER, BEFORE, passed=1, contact=True)
    assert (hit.ended[0], hit.gates[0], hit.v_max[0]) == (trial.COLLISION, 1, 0.0)
    assert judged(AFTER, BEFORE).gates[0] == 0, "a gate out of its turn"
    # Past the last gate the last is next.
    course = trial.Course(Gates(*(np.stack([field] * 3) for field in GATES)), np.full(3, 2))
    assert trial.next_gate(course, np.array([0, 1, 5])).center_w[:, 0].tolist() == [1.0, 2.0, 2.0]


def test_late_and_lost():
    assert judged((0, 0, 1), step=9999).ended[0] == trial.FLYING
    assert judged((0, 0, 1), step=10000).ended[0] == trial.TIMEOUT
    lost = judged((np.nan, 0, 1), (0, 0, 1), diverged=True)
    assert lost.ended[0] == trial.DIVERGED and np.isfinite(lost.pos_w).all()


@pytest.mark.parametrize(("angle_deg", "tipped"), [(89.9, 0), (90.1, 1), (180.0, 1)])
def test_a_trial_ends_as_tipped_from_90_degrees_on_and_not_before(angle_deg, tipped):
    cos, sin = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    rolled = np.array([[[1.0, 0.0, 0.0], [0.0, cos, -sin], [0.0, sin, cos]]])
    assert judged((0, 0, 1), rot_w=rolled).ended[0] == (trial.TIPPED if tipped else trial.FLYING)
    on_its_side = np.array([[[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]])
    assert judged((0, 0, 1), rot_w=on_its_side).ended[0] == trial.FLYING


def test_gates_of_the_first_8_s_count_up_to_that_very_step():
    """8 s are 4,000 steps of 2 ms."""
    assert judged((1.1, 0, 1.5), (0.9, 0, 1.5), step=4000).gates_8s[0] == 1
    assert judged((1.1, 0, 1.5), (0.9, 0, 1.5), step=4001).gates_8s[0] == 0


def test_what_is_no_state_and_no_wrench():
    fine = np.zeros((3, 3))
    vel_w = np.array([[0.0, 1000.0, 0.0], [1001.0, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    motion = Motion(fine, np.tile(np.eye(3), (3, 1, 1)), vel_w, fine)
    np.testing.assert_array_equal(trial.has_diverged(trial.Rules(), motion), [False, True, True])
    torque_b = np.array([[0.0, 1e6, 0.0], [2e6, 0.0, 0.0], [np.inf, 0.0, 0.0]])
    np.testing.assert_array_equal(
        trial.is_wrench(trial.Rules(), Wrench(fine, torque_b)), [True, False, False]
    )


TRIAL = trial.TrialSpec("zigzag", 3, 7)


def test_a_layout_holds_every_track_and_padding_repeats_the_last_gate():
    layout = layout_of([straight(tuple(range(1, 12)))])
    assert layout.gates == 11 and layout.corners == 4
    assert layout.solids == layout_of([]).solids
    padded = slots.pad_gates(GATES, 4, 6)
    np.testing.assert_array_equal(padded.center_w[:, 0], [1.0, 2.0, 2.0, 2.0])
    np.testing.assert_array_equal(padded.opening_g[:, 3:], padded.opening_g[:, 3:4].repeat(3, 1))


def test_a_track_with_meshes_is_a_group_of_its_own():
    plain = straight((1.0, 2.0))
    tracks = {"a.toml": plain, "m.toml": replace(plain, mesh_sizes=(12,))}
    trials = [TRIAL._replace(track=name) for name in ("zigzag", "m.toml", "a.toml", "m.toml")]
    assert slots.slot_groups(trials, tracks) == [[0, 2], [1, 3]]
    assert slots.slot_groups([], {}) == []


def gusts(trial, count):
    return GustDraws(trial).at(0, count)


def test_a_trials_random_numbers_are_its_own_for_each_use():
    np.testing.assert_array_equal(gusts(TRIAL, 5), gusts(TRIAL, 9)[:5])
    others = TRIAL._replace(seed=8), TRIAL._replace(difficulty=4), TRIAL._replace(track="circular")
    for other in others:
        assert (gusts(other, 5) != gusts(TRIAL, 5)).all()
    here, there = (TRIAL._replace(track=f"{way}own.toml") for way in ("", "./courses/"))
    np.testing.assert_array_equal(gusts(here, 5), gusts(there, 5))
    assert slots.generator_of(TRIAL, slots.SENSED).standard_normal() != gusts(TRIAL, 1)[0, 0]


def test_gusts_are_drawn_as_the_flight_goes_on():
    drawn, rng = GustDraws(TRIAL), slots.generator_of(TRIAL, slots.GUSTS)
    whole = rng.standard_normal((4 * GUSTS_AT_ONCE, 3))
    last = GUSTS_AT_ONCE - 1
    for step, count in ((0, 1), (1, 5), (last, 3), (3 * last, 2 * last), (2, 4)):
        wanted = whole[step : step + count]
        np.testing.assert_array_equal(drawn.at(step, count)[: len(wanted)], wanted)
    kept = GustDraws(TRIAL)
    for step in range(0, 100 * GUSTS_AT_ONCE, 50):
        kept.at(step, 60)
    assert len(kept._rows) < 3 * GUSTS_AT_ONCE, "an hour's are not kept"
