"""What a Delta Action Model corrects: its checkpoint says so, and a training is held to it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from suite.delta.replay import nominal_model
from suite.delta.windows import RATE_SHARE
from suite.train.config import PointMassConfig, QuadrotorConfig
from tracks.common.files import plain

POINT, QUAD = "point", "quad"
"""The two models, as `suite train --model` calls them."""


def corrected(dynamics: PointMassConfig | QuadrotorConfig) -> dict[str, Any]:
    """Return what a checkpoint keeps of the dynamics that were fitted.

    The point mass's are the middle of its ranges; of a vehicle file everything but its name counts.
    """
    if isinstance(dynamics, PointMassConfig):
        return {"model": POINT, "plant": plain(nominal_model(dynamics))}
    return {"model": QUAD, "plant": {**plain(dynamics.vehicle), "name": ""}}


def check_corrects(
    fit: Mapping[str, Any],
    dynamics: PointMassConfig | QuadrotorConfig,
    rate_hz: float,
    where: Path,
) -> None:
    """Refuse a Delta Action Model of other dynamics than those that are trained through.

    Args:
        fit: of the checkpoint; one that does not say what it corrects passes for a point mass, and
            one that does not say its rate for any.
        dynamics: what is trained through.
        rate_hz: of the policy that is trained: the network steps once a decision.
        where: the checkpoint, for the message.

    Raises:
        ValueError: where they differ.
    """
    mine = corrected(dynamics)
    model = fit.get("model", POINT)
    if model != mine["model"]:
        raise ValueError(
            f"--delta {where} corrects --model {model}, and this run has --model "
            f"{mine['model']}; train with the model that it was fitted to"
        )
    rate = fit.get("rate_hz", rate_hz)
    if abs(rate - rate_hz) > RATE_SHARE * rate_hz:
        raise ValueError(
            f"--delta {where} was fitted to flights of {rate:.3g} decisions a second, and this "
            f"run has {rate_hz:g}: it remembers from one to the next; fit again to flights of a "
            f"policy of {rate_hz:g} Hz, or give --set spec.rate_hz={round(rate)}"
        )
    plant = fit.get("plant", mine["plant"])
    if plant == mine["plant"]:
        return
    if isinstance(dynamics, QuadrotorConfig):
        name = dynamics.vehicle.name
        raise ValueError(
            f"--delta {where} was fitted to another vehicle than {name!r}; take its "
            f"--vehicle, or fit again with suite delta --model {QUAD} --vehicle"
        )
    raise ValueError(
        f"--delta {where} corrects a point mass with {_words(plant)}, and this run's has "
        f"{_words(mine['plant'])}; take the --preset it was fitted to, or fit again with suite "
        "delta --preset"
    )


def _words(plant: Mapping[str, Any]) -> str:
    drag = " ".join(f"{axis:.3g}" for axis in plant["drag"])
    return f"lag {plant['lag']:.3g} 1/s, drag {drag} 1/s, delay {plant['delay']:.3g} decisions"
