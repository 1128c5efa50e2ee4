"""A plugin: a package that adds a physical effect, a track family, a log format and a simulator.

Entry points in its pyproject.toml make them available in all commands of the suite.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from eval.effects.interface import Array, Effect, Flow, Parameter
from eval.importers.options import ImportOptions
from eval.importers.signals import Recording, collect
from eval.vehicles.vehicle import Vehicle
from eval.worlds.mujoco import MujocoWorld
from tracks.families.layout import GATE_COUNT, Layout, counts_per_stretch, furnish, noisy_gates
from tracks.geometry.obstacles import straight_sites


class FinDrag(NamedTuple):
    """Parameters of the effect `fin_drag`."""

    coefficient: Array
    """(...,) c [kg/m]."""


def fin_force(values: FinDrag, flow: Flow) -> Array:
    """Return -c |v_y| v_y along body y (..., 3) [N], for numpy and JAX arrays."""
    xp = flow.air_vel_b.__array_namespace__()
    sideways = flow.air_vel_b[..., 1]
    force = -values.coefficient * xp.abs(sideways) * sideways
    return force[..., None] * xp.asarray([0.0, 1.0, 0.0])


FIN_DRAG = Effect(
    name="fin_drag",
    summary="A vertical fin that is pushed by sideways flow",
    equation="F_b = -c |v_y| v_y e2",
    source="flat plate",
    values=FinDrag,
    parameters=(
        Parameter(
            name="coefficient", unit="kg/m", neutral=0.0, low=0.0, high=1.0, typical=(0.01, 0.1)
        ),
    ),
    force=fin_force,
)


def staircase(d: float, rng: np.random.Generator) -> Layout:
    """Staircase: eight gates in a line along world x, each higher than the one before."""
    step = np.arange(GATE_COUNT)
    center_w = np.stack([5.0 * step, 0.0 * step, 0.8 + (0.05 + 0.12 * d) * step], axis=-1)
    gates = noisy_gates(rng, d, center_w, np.zeros(GATE_COUNT))
    start_pos_w = gates.center_w[0] - np.array([rng.uniform(2.0, 3.0), 0.0, 0.0])
    stretches = step[:-1]
    site = straight_sites(gates, stretches, 3.6)
    return furnish(rng, gates, start_pos_w, counts_per_stretch(rng, d, len(stretches)), site)


SUMMARY = "simlog: numbers in lines, t x y z qw qx qy qz p q r m1 m2 m3 m4"
"""Summary of the log format. A module with SUMMARY, `detect` and `read` is a log format."""


def detect(head: bytes, options: ImportOptions) -> bool:
    """Return whether a file with these first bytes is a simlog."""
    return head.startswith(b"# simlog")


def read(path: Path, options: ImportOptions) -> Recording:
    """Return the file's signals in SI units, z-up world and forward-left-up body."""
    table = np.loadtxt(path)
    columns = {"pos": slice(1, 4), "quat": slice(4, 8), "rate": slice(8, 11),
               "motor": slice(11, 15)}  # fmt: skip
    samples = {name: (table[:, 0], table[:, column]) for name, column in columns.items()}
    signals, findings = collect(samples, str(path))
    return Recording(str(path), signals, findings)


class CoarseWorld(MujocoWorld):
    """MuJoCo with half as many physics steps a second."""

    def __init__(self, vehicle: Vehicle, *args: Any, **options: Any) -> None:
        """Make the world; the arguments are those of `MujocoWorld`."""
        slower = replace(vehicle.controller, frequency=vehicle.controller.frequency / 2)
        super().__init__(replace(vehicle, controller=slower), *args, **options)
