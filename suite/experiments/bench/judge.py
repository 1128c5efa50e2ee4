"""The benchmark `judge`: trials per second of the judge, against depth images by `mj_multiRay`.

The suite casts the rays of all images together (`tracks/geometry/tiles.py`). The baseline casts the
rays of one camera after the other, and flies 64 trials at once. Both are timed by the processor
time of the process, which depends little on other work on the machine.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import mujoco
import numpy as np

from eval.judging.judge import JudgeOptions, fly
from eval.quadrotor.vehicle_file import load_vehicle
from eval.worlds import WORLDS
from eval.worlds.mujoco import MujocoWorld
from eval.worlds.trial import Rules, TrialResult, TrialSpec
from policies.policy import load_policy
from suite.experiments.bench.compare import Comparison, compare_times, in_turn
from suite.judging.flying import default_policy
from tracks.families import JUDGED

BASELINE = "mujoco-own-rays"
"""Name of the baseline's simulator."""


class OwnRays(MujocoWorld):
    """The simulator `mujoco` with depth images from MuJoCo's own ray casting."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._scenes: dict[int, tuple[mujoco.MjModel, mujoco.MjData]] = {}

    def _images(self, slots: np.ndarray, pos_w: np.ndarray, rot_w: np.ndarray) -> np.ndarray:
        """Return the depth images of the environments `slots`, one camera after the other."""
        images = []
        for row, slot in enumerate(slots.tolist()):
            model = self._models[slot]
            if self._scenes.get(slot, (None, None))[0] is not model:
                self._scenes[slot] = model, mujoco.MjData(model)
                mujoco.mj_kinematics(*self._scenes[slot])
            # `_depth_camera` has the policy's camera model; it casts the rays by `mj_multiRay`.
            images.append(self._depth_camera.image(*self._scenes[slot], pos_w[row], rot_w[row]))
        return np.array(images)


def run(policy: str = "", trials: int = 128, time_limit_s: float = 20.0) -> Comparison:
    """Time both in turn, and count the trials (of at most `time_limit_s` [s]) that end alike."""
    if BASELINE not in WORLDS:
        WORLDS.register(BASELINE, OwnRays)
    loaded, vehicle = load_policy(policy or default_policy()), load_vehicle("reference")
    # JUDGED: the three track families of the results tables.
    specs = [TrialSpec(JUDGED[k % 3], 9, k // 3) for k in range(trials)]
    results: dict[str, list[TrialResult]] = {}

    def judge(simulator: str, slots: int) -> None:
        options = JudgeOptions(slots=slots, workers=1, rules=Rules(time_limit_s=time_limit_s))
        results[simulator] = fly(loaded, specs, vehicle, simulator, options)

    ours = partial(judge, "mujoco", JudgeOptions().slots)
    calls = {"ours": ours, "baseline": partial(judge, BASELINE, 64)}
    times_s = in_turn(calls, rounds=2, clock=time.process_time)
    pairs = list(zip(*results.values(), strict=True))
    same = sum((a.ended_by, a.gates_passed) == (b.ended_by, b.gates_passed) for a, b in pairs)
    details = {
        "policy": loaded.name,
        "rays_a_pixel": loaded.spec.camera.rays**2,
        "trials": trials,
        "trials_that_end_alike": same,
        "images_a_trial": float(np.mean([a.time_s for a, _ in pairs])) * loaded.spec.rate_hz,
    }
    return compare_times("judge", times_s, trials, "trials/s of processor time", details)
