"""Diagnose MuJoCo-made flights with one known effect each, and print what was named.

python tools/diagnose_cases.py --seed 0 --flights 3 [CASE ...]
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

CASES: dict[str, dict[str, tuple]] = {
    "null": {},
    "linear_drag": {"linear_drag": ((0.03, 0.03, 0.01),)},
    "quadratic_drag": {"quadratic_drag": ((0.005, 0.005, 0.01),)},
    "rotor_drag": {"rotor_drag": (3e-5,)},
    "inflow": {"inflow": (2e-5,)},
    "translational_lift": {"translational_lift": (0.003,)},
    "blade_flapping": {"blade_flapping": (1e-7,)},
    "ground_effect": {"ground_effect": (4.0, 0.0635)},
    "motor_lag": {"motor_lag": (0.035,)},
    "command_delay": {"command_delay": (0.004,)},
    "thrust_scale": {"thrust_scale": (0.98,)},
    "battery_sag": {"battery_sag": (1e-3, 0.0)},
    "mass_offset": {"mass_offset": (0.01,)},
    "com_offset": {"com_offset": ((0.0002, 0.0, 0.0),)},
    "torque_trim": {"torque_trim": ((0.001, 0.0, 0.0),)},
    "inertia_scale": {"inertia_scale": ((1.05, 1.0, 1.0),)},
    "rotor_gyroscopic": {"rotor_gyroscopic": (2e-5,)},
    "rate_gain": {"rate_gain": ((0.95, 1.0, 1.0),)},
    "angular_damping": {"angular_damping": ((0.3, 0.3, 0.3),)},
    "weak_motor": {"weak_motor": ((1.0, 0.98, 1.0, 1.0),)},
    "thrust_tilt": {"thrust_tilt": ((0.003, 0.0),)},
    "frame_tilt": {"frame_tilt": ((0.004, 0.0),)},
    "gyro_bias": {"gyro_bias": ((0.01, 0.0, 0.0),)},
    "clock_offset": {"clock_offset": (0.003,)},
    "drag and gyro_bias": {
        "linear_drag": ((0.1, 0.1, 0.05),),
        "gyro_bias": ((0.01, 0.0, 0.0),),
    },
    "wind": {"linear_drag": ((0.3, 0.3, 0.1),), "constant_wind": ((2.0, 0.0, 0.0),)},
}


def main() -> None:
    """Fly and diagnose the cases that were asked for, or all of them."""
    from suite.diagnose.answer import answer
    from suite.diagnose.diagnose import diagnose
    from tests.support.diagnosis_flights import fly
    from tests.support.vehicles import PLAIN, with_effects, with_lag

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", nargs="*", metavar="CASE")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--duration", type=float, default=8.0)
    options = parser.parse_args()
    vehicle = with_lag(PLAIN, 0.03)
    for name in options.cases or CASES:
        true = with_effects(vehicle, **CASES[name])
        seeds = range(options.seed, options.seed + options.flights)
        logs = [fly(true, seed, duration_s=options.duration) for seed in seeds]
        began = time.process_time()
        found = answer(diagnose(logs, vehicle))
        names = [" or ".join([e["name"], *e["alternatives"]]) for e in found["effects"]]
        gap = found["gap"]
        print(
            f"{name}: {found['verdict']}: {', '.join(names) or '-'}; gap {gap['before']:.2f} -> "
            f"{gap['after']:.2f}; {time.process_time() - began:.1f} s of processor time",
            flush=True,
        )


if __name__ == "__main__":
    main()
