"""Collective thrust as a share of the largest, as MAVLink's set points have it."""

from __future__ import annotations

from eval.vehicles.vehicle import Vehicle


def full_thrust(vehicle: Vehicle) -> float:
    """Return the nominal vehicle's largest collective thrust per mass [m/s^2], a share of 1.

    A real autopilot's thrust is a share of its own; docs/fly.md says how to measure it.
    """
    return 4.0 * vehicle.rotors.thrust_max / vehicle.mass
