"""The simulator mjx agrees with the simulator mujoco within stated tolerances."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from eval.effects.slung_load import SlungLoad
from eval.judging.judge import JudgeOptions, Record, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.vehicles.vehicle import with_effects
from eval.worlds.collision import NEAR
from eval.worlds.trial import Rules, TrialSpec
from policies.spec import PolicySpec
from tests.support.courses import fly_on, straight
from tests.support.marks import more
from tests.support.pilots import Pursuit, Steady
from tracks.geometry.scene import Boxes

VEHICLE = load_vehicle("reference")
POSITION_TOLERANCE_M = 2e-4
"""Between float32 and float64 states after 2 s of closed loop: the loop damps the rounding of each
step, 1e-7, and this policy does not use its image."""


def both(trials, rules=None, record=None, vehicle=VEHICLE, tracks=None):
    slots = min(6, len(trials))
    options, found = JudgeOptions(slots=slots, workers=1, rules=rules or Rules()), []
    for world in ("mujoco", "mjx"):
        flights = {}

        def keep(result, flight, flights=flights):
            flights[result.trial] = flight

        results = fly(Pursuit(), trials, vehicle, world, options, keep, record, tracks)
        found.append((results, flights))
    return found


@pytest.fixture(scope="module", params=["small", more("families")])
def few(request):
    """Flights on small tracks, whose program compiles soon, or on those of the families."""
    how = Rules(time_limit_s=1.6), Record(depth=True)
    if request.param == "families":
        kinds = (("zigzag", 0), ("circular", 0), ("ellipse", 1))
        return both([TrialSpec(track, 9, seed) for track, seed in kinds], *how)
    tracks = {"clear": straight(name="clear"), "walled": straight(wall_at=1.0, name="walled")}
    return both([TrialSpec(name, 0, 0) for name in tracks], *how, tracks=tracks)


def test_states_and_images_agree(few):
    (_, ours), (_, theirs) = few
    for trial in ours:
        a, b = ours[trial], theirs[trial]
        rows = min(len(a.time_s), len(b.time_s), 200) - 1
        assert rows > 20 and np.abs(a.time_s[:rows] - b.time_s[:rows]).max() < 1e-5
        assert np.abs(a.pos_w[:rows] - b.pos_w[:rows]).max() < POSITION_TOLERANCE_M
        assert np.abs(a.vel_w[:rows] - b.vel_w[:rows]).max() < 10 * POSITION_TOLERANCE_M
        assert np.abs(a.rotor_speed[:rows] - b.rotor_speed[:rows]).max() < 2.0
        assert (a.policy_step[:rows] == b.policy_step[:rows]).all()
        images = int(a.policy_step[:rows].sum())
        near = np.abs(a.depth_m[:images] - b.depth_m[:images]) < 0.01
        assert near.mean() > 0.995  # the rest are pixels on an edge


def test_ends_agree_on_a_few(few):
    (ours, _), (theirs, _) = few
    assert len({r.ended_by for r in ours}) >= 2
    assert [r[7:10] for r in ours] == [r[7:10] for r in theirs]  # gates, end and what was hit


def small_boxes(track, count):
    """Return a track with small boxes about its start, all of them nearer than its wall."""
    angle = np.linspace(0.0, 2 * np.pi, count, endpoint=False)
    around = np.stack([-1.0 + 0.0 * angle, np.cos(angle), np.sin(angle)], 1)
    boxes = track.scene.boxes
    boxes = Boxes(
        np.vstack([boxes.center_w, track.start_pos_w + around]),
        np.vstack([boxes.rot_w, np.tile(np.eye(3), (count, 1, 1))]),
        np.vstack([boxes.half_size, np.full((count, 3), 0.05)]),
    )
    names = (*track.names, *(f"box {k}" for k in range(count)))
    return replace(track, scene=track.scene._replace(boxes=boxes), names=names)


@pytest.mark.slow
def test_who_decides_rarely_meets_what_was_not_near_when_it_decided():
    track = small_boxes(straight((20.0, 30.0), wall_at=6.0), 2 * NEAR.boxes)
    pilot = Steady((4.0, 0.0, 1.6), PolicySpec(rate_hz=1.0))
    how = {"vehicle": VEHICLE, "slots": 1, "workers": 1, "rules": Rules(time_limit_s=2.5)}
    ours, theirs = (fly_on(pilot, track, world=w, **how)[0][0] for w in ("mujoco", "mjx"))
    assert ours.collided_with == theirs.collided_with == "the wall"
    assert ours.pos_x == pytest.approx(theirs.pos_x, abs=0.01)


def test_a_track_beyond_single_precision_is_refused():
    track = straight((2.0, 4.0, 1500.0))
    with pytest.raises(ValueError, match="'straight' reaches 1500 m .* single precision"):
        fly_on(Steady(), track, vehicle=VEHICLE, world="mjx")


@pytest.mark.slow
def test_a_load_on_a_line_swings_alike():
    trials = [TrialSpec("zigzag", 9, seed) for seed in range(2)]
    loaded = with_effects(VEHICLE, {"slung_load": SlungLoad(0.05, 0.5)})
    (_, ours), (_, theirs) = both(trials, Rules(time_limit_s=1.2), Record(), loaded)
    for trial in ours:
        rows = min(len(ours[trial].time_s), len(theirs[trial].time_s)) - 1
        assert rows > 60
        gap = np.abs(ours[trial].pos_w[:rows] - theirs[trial].pos_w[:rows]).max()
        assert gap < POSITION_TOLERANCE_M


@pytest.mark.slow
def test_ends_agree_on_many():
    kinds = product(("zigzag", "circular", "ellipse"), (0, 3, 6, 9), range(25))
    trials = [TrialSpec(*kind) for kind in kinds]
    (ours, _), (theirs, _) = both(trials)
    agree = np.mean([a.ended_by == b.ended_by for a, b in zip(ours, theirs, strict=True)])
    assert agree >= 0.99
