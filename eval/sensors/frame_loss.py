"""Images that do not come, alone or in bursts; the one before is seen again."""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.sensors.interface import (
    Array,
    Moment,
    Needs,
    Parameter,
    Sensor,
    View,
    absent,
    over_image,
    sticky,
)


class FrameLoss(NamedTuple):
    """Values of `frame_loss`."""

    share: Array
    length: Array


def start(values: FrameLoss, moment: Moment) -> dict[str, Any]:
    """Return that nothing is lost; the first image always comes."""
    return {"lost": absent(values, moment), "shown_m": moment.truth.depth_m}


def sense(
    values: FrameLoss, memory: dict[str, Any], seen: View, moment: Moment
) -> tuple[View, dict[str, Any]]:
    """Return the view with the image that came last."""
    xp = seen.depth_m.__array_namespace__()
    chance = moment.draws.uniform[..., 0]
    lost = sticky(memory["lost"], chance, values.share, values.length, moment.dt_s)
    shown_m = xp.where(over_image(lost), memory["shown_m"], seen.depth_m)
    return seen._replace(depth_m=shown_m), {"lost": lost, "shown_m": shown_m}


SENSOR = Sensor(
    name="frame_loss",
    stage="depth",
    summary="Images are lost, alone or in bursts, and the one before is seen again",
    equation="Markov chain: lost for `share` of the images, `length` at a time; z = z of the last",
    source="our estimate",
    values=FrameLoss,
    parameters=(
        Parameter("share", "1", 0.0, 0.0, 0.95, (0.01, 0.1)),
        Parameter("length", "s", 0.0, 0.0, 10.0, (0.05, 0.3)),
    ),
    grows=("share",),
    trial=Needs(uniform=1),
    observation=Needs(uniform=1),
    start=start,
    sense=sense,
)
