"""Warnings about the vehicle files that a command's options name."""

from __future__ import annotations

from typing import Any

from suite.common.console import Console

OPTIONS = ("vehicle", "hidden_vehicle")
"""Options that name a vehicle file."""
OWN_CHECK = ("check", "delta", "diagnose", "identify")
"""Commands that list these doubts among the findings about their flights."""


def warn_of_vehicles(command: str, config: Any, console: Console) -> None:
    """Print the doubts about the vehicle files that the options `config` of a command name.

    A file that cannot be read is left to the command, which refuses it.
    """
    groups = [config, getattr(config, "flown", None)]
    values = [getattr(group, option, None) for group in groups for option in OPTIONS]
    names = dict.fromkeys(str(value) for value in values if value)
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
