"""Thrust of a motor from its command and the battery: the vehicle file's `[motors]`.

`T = t1 u + t2 u^2` with `u = command (V / V0)^n`: command from 0 to 1, V the battery's voltage, V0
the nominal one. n = 1 where the command is a share of the battery's voltage (PWM of a brushed
motor), n = 0 where the firmware makes up for the battery itself.
"""

from __future__ import annotations

from typing import Any

from eval.vehicles.vehicle import MotorMap, Vehicle


def motor_thrust(motors: MotorMap, command: Any, voltage: Any = None) -> Any:
    """Return the thrusts (..., 4) [N].

    Args:
        motors: the map.
        command: (..., 4) from 0 to 1.
        voltage: (...,) of the battery [V]; None: the nominal one.
    """
    applied = command
    if voltage is not None and motors.voltage_exponent:
        applied = command * ((voltage / motors.voltage) ** motors.voltage_exponent)[..., None]
    first, second = motors.thrust
    return first * applied + second * applied**2


def command_of_thrust(curve: tuple[Any, Any], thrust: Any) -> Any:
    """Return what is applied, u of `T = t1 u + t2 u^2`, for thrusts (...) from 0 [N].

    Args:
        curve: t1, t2 [N], which grows.
        thrust: [N].
    """
    first, second = curve
    xp = thrust.__array_namespace__()
    root = xp.sqrt(xp.maximum(first**2 + 4.0 * second * thrust, 1e-12))
    return 2.0 * thrust / xp.maximum(first + root, 1e-6)


def motor_speed(vehicle: Vehicle, command: Any, voltage: Any = None) -> Any:
    """Return the commanded rotor speeds (..., 4) [rad/s] of motor commands; see `motor_thrust`.

    Raises:
        ValueError: where the vehicle has no `[motors]`.
    """
    if vehicle.motors is None:
        raise ValueError(
            f"vehicle {vehicle.name!r} has no [motors]: nothing says what thrust a motor command "
            "gives; add it, or let `suite identify` find it"
        )
    thrust = motor_thrust(vehicle.motors, command, voltage)
    xp = thrust.__array_namespace__()
    return xp.sqrt(xp.maximum(thrust, 0.0) / vehicle.rotors.thrust_coefficient)
