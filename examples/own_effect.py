"""Add a physical effect to the suite: a tether that pulls the drone back to the world's origin.

Simulators, the differentiable quadrotor of the trainer and the diagnosis use it without further
code. To have it in every command, put the file into a package with an entry point of the group
`diffracing_suite.effects` (examples/plugin). Run: python examples/own_effect.py
"""

from __future__ import annotations

from typing import NamedTuple

from eval.effects.interface import Array, Effect, Flow, Parameter
from eval.vehicles.vehicle import with_effects
from suite import evaluate_policy, load_policy, load_vehicle, register_effect
from tracks.geometry.rotation import to_local


class Tether(NamedTuple):
    """Parameters of the effect `tether`."""

    stiffness: Array
    """(...,) [N/m]."""


def pull(values: Tether, flow: Flow) -> Array:
    """Return the force R^T (-k p) (..., 3) in body axes [N], for numpy and JAX arrays."""
    return to_local(flow.rot_w, -values.stiffness[..., None] * flow.pos_w)


TETHER = Effect(
    name="tether",
    summary="An elastic tether to the origin of the world",
    equation="F_b += R^T (-k p)",
    source="Hooke 1678",
    values=Tether,
    parameters=(
        Parameter("stiffness", "N/m", neutral=0.0, low=0.0, high=10.0, typical=(0.02, 0.2)),
    ),
    force=pull,
)


def main() -> None:
    """Register the effect, and fly without a tether and with one."""
    register_effect(TETHER)
    vehicle, policy = load_vehicle("reference"), load_policy("race")
    for stiffness in (0.0, 0.4):
        tethered = with_effects(vehicle, {TETHER.name: Tether(stiffness)})
        (result,) = evaluate_policy(
            policy, track="zigzag", difficulty=0, trials=1, seed=1, vehicle=tethered, workers=1
        )
        print(f"{stiffness:.1f} N/m: {result.gates_passed} gates, {result.ending}")


if __name__ == "__main__":
    main()
