"""The rate loops of flight controller firmwares (body rates to motor commands), one file each.

A vehicle file selects a loop by `[controller] kind`. The module of a kind has `Settings` (with the
firmware's keys), `GROUP` (the settings' table under `[controller]`, "" for none), `LIMITS` (their
ranges), `gains`, `start` and `update`. The nominal loop, kind `p`, is
`eval.quadrotor.mixer.rate_torque` and has no state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from eval.quadrotor.loops import betaflight, crazyflie, px4
from eval.quadrotor.loops.filters import Request, layout_of
from eval.vehicles.vehicle import Controller, MotorMap, Vehicle, command_of_thrust
from tracks.geometry.scene import Array

NOMINAL = "p"
"""Kind of the nominal rate loop."""
KINDS: dict[str, Any] = {"betaflight": betaflight, "px4": px4, "crazyflie": crazyflie}
"""Kind -> module of the firmware's loop; `p` is not among them."""
_MODULES = {module.Gains: module for module in KINDS.values()}
"""Class `Gains` of a loop's constants -> module of the loop."""


class Loop(NamedTuple):
    """A firmware's rate loop and the thrust curve of its motors."""

    gains: Any
    """The loop's constants, a `Gains` of the kind's module."""
    thrust: tuple[Array, Array]
    """Coefficients t1, t2 of a rotor's thrust T = t1 u + t2 u^2 [N] at the nominal voltage, where u
    is the motor command from 0 to 1."""


def loop_of(vehicle: Vehicle) -> Loop | None:
    """Return the firmware's loop of a vehicle, or None for the nominal one.

    Without `[motors]`, a motor command is the ratio of a rotor's speed to its largest speed. For
    the Crazyflie, whose firmware compensates the motors' curve, it is the ratio of thrusts.
    """
    controller = vehicle.controller
    if controller.kind == NOMINAL:
        return None
    import numpy as np

    full_thrust = vehicle.rotors.thrust_max
    is_linear = controller.kind == "crazyflie"
    motors = vehicle.motors or MotorMap(
        (full_thrust, 0.0) if is_linear else (0.0, full_thrust), 1.0
    )
    gains = KINDS[controller.kind].gains(controller.settings, layout_of(vehicle.rotors))
    first, second = motors.thrust
    return Loop(gains, (np.asarray(first), np.asarray(second)))


def command_of_throttle(controller: Controller, throttle: Array) -> Array:
    """Return the motor commands (...) that a firmware makes of a throttle (...) at rest.

    Both are from 0 to 1. Betaflight's throttle is 0 at the motors' idle, and that of PX4 is a
    thrust, which `THR_MDL_FAC` linearises. Others are motor commands already.
    """
    if controller.kind == "betaflight":
        idle = 1e-4 * controller.settings.dshot_idle_value
        return idle + (1.0 - idle) * throttle
    if controller.kind == "px4":
        return px4.signal(controller.settings.THR_MDL_FAC, throttle)
    return throttle


def start(loop: Loop | None, shape: tuple[int, ...], xp: Any) -> Any:
    """Return the state of loops with the batch shape `shape` before their first update."""
    return () if loop is None else _MODULES[type(loop.gains)].start(shape, xp)


def update(
    loop: Loop,
    memory: Any,
    force_z: Array,
    rate_cmd_b: Array,
    rate_b: Array,
    dt: Array,
    scale: Array,
) -> tuple[Any, Array]:
    """Return the loop's state after an update and the commanded rotor thrusts (..., 4) [N].

    Args:
        loop: the loop.
        memory: state from `start` or the previous update.
        force_z: (...,) wanted collective thrust [N].
        rate_cmd_b: (..., 3) commanded body rates [rad/s].
        rate_b: (..., 3) current body rates [rad/s].
        dt: time since the last update [s], a number or (..., 1).
        scale: (..., 3) factor on the loop's output, by the effect `rate_gain`.
    """
    xp = rate_b.__array_namespace__()
    first, second = loop.thrust
    rotor_thrust = xp.maximum(0.25 * force_z, 0.0)
    throttle = xp.clip(command_of_thrust(loop.thrust, rotor_thrust), 0.0, 1.0)
    module = _MODULES[type(loop.gains)]
    request = Request(throttle, rate_cmd_b, rate_b, dt, scale)
    memory, command = module.update(loop.gains, memory, request)
    return memory, first * command + second * command**2
