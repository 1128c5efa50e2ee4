"""Warnings about the vehicle files that a command's options name."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from suite.common.console import Console
from suite.common.options import options

if TYPE_CHECKING:
    from eval.vehicles.vehicle import Vehicle
    from tracks.geometry.camera import Camera

OWN_CHECK = ("check", "delta", "diagnose", "identify")
"""Commands that list these doubts among the findings about their flights."""

OTHER_CAMERA = "simulated images are those of the policy's camera; train a policy for the vehicle's"
"""Advice for flights of a policy with another camera than that of the vehicle file."""


def warn_of_vehicles(command: str, config: Any, console: Console) -> None:
    """Print the doubts about vehicle files in the options `config`, whose names end in "vehicle".

    A file that cannot be read is left to the command, which refuses it.
    """
    given = (o.default for o in options(type(config), config) if o.field.endswith("vehicle"))
    names = dict.fromkeys(name for name in given if name)
    if command in OWN_CHECK or not names:
        return
    from eval.logs.faults.vehicle import vehicle_doubts
    from eval.quadrotor.vehicle_file import load_vehicle

    for name in names:
        try:
            doubts = vehicle_doubts(load_vehicle(name))
        except (ValueError, OSError):
            continue
        for doubt in doubts:
            console.note(f"warning: {doubt}")


def camera_warnings(policy: Camera, vehicle: Vehicle, advice: str = OTHER_CAMERA) -> list[str]:
    """Return a warning with `advice` if the camera of a policy is not that of the vehicle file.

    A vehicle file without a camera has the default one, which says nothing about the vehicle.
    """
    from eval.logs.faults.vehicle import check_camera
    from tracks.geometry.camera import Camera

    findings = [] if vehicle.camera == Camera() else check_camera(policy, vehicle)
    return [f"{each.evidence}; {advice}" for each in findings if each.status != "ok"]
