"""The faults that checks of a log can name, each with a manoeuvre that makes it identifiable.

A manoeuvre is an instruction in words for a new flight or a new log.
"""

from __future__ import annotations

ROTATE = "rotate the vehicle by hand, propellers off, by 90 deg and back about x, then y, then z"
TILT = "fly 2 m forward and back, then 2 m left and back, briskly"
CLIMB = "climb and descend briskly, from a full to an almost empty battery"
PULSE = "propellers off or the vehicle held down: pulse motor 1, then 2, 3 and 4, a second each"
STICKS = "hold a roll, a pitch and a yaw rate of 1 rad/s and of 3 rad/s for a second each"
HOVER = "hover for two seconds"
REST = "let the vehicle rest, level, for a second"
FASTER = "log at twice the controller's rate"
GROUND = "log from two seconds before the motors start"

FAULTS: dict[str, tuple[str, str]] = {
    "attitude": ("the attitude fits neither the path nor the gyro", ROTATE),
    "attitude_sign": ("roll, pitch or yaw has the other sign", ROTATE),
    "quaternion_order": ("the quaternion's columns are in another order", ROTATE),
    "quaternion_direction": ("the quaternion maps world to body", ROTATE),
    "world_frame": ("the world points down (NED), or east comes first", TILT),
    "body_frame": ("the body is forward-right-down", ROTATE),
    "position_axes": ("an axis of the position is inverted or swapped", TILT),
    "position_jump": ("the position jumps or stands still", "log again"),
    "position_delay": ("the position is late, or is its set point", TILT),
    "position_unit": ("positions are in cm, mm or feet", TILT),
    "heading": ("position and attitude differ in their heading", TILT),
    "velocity_frame": ("the velocity is in other axes", TILT),
    "velocity_unit": ("the velocity is in another unit", TILT),
    "velocity_mean": ("the velocity is not that of the path, but of the air", TILT),
    "velocity_delay": ("velocity or position is late against the other", TILT),
    "gyro_axes": ("axes of the gyro are inverted, swapped, dead or commands", ROTATE),
    "gyro_frame": ("rates are in world axes", ROTATE),
    "gyro_scale": ("the gyro is in another unit, or its scale is wrong", ROTATE),
    "accelerometer_unit": ("the accelerometer is in another unit, or in raw counts", REST),
    "accelerometer_axes": ("axes of the accelerometer are inverted", ROTATE),
    "accelerometer_gravity": ("gravity was taken out of the accelerometer", ROTATE),
    "accelerometer_throttle_bias": ("vibration biases the accelerometer", PULSE),
    "barometer_spin_up": ("the barometer's height falls as the motors start", GROUND),
    "time_unit": ("times are in ms, us or ns, or by a clock of another rate", TILT),
    "time_stamps": ("stamps are 0 or go back", "log again"),
    "clock_offset": ("pose or gyro is late", ROTATE),
    "clock_drift": ("the pose's clock runs faster or slower than the gyro's, or jumps", ROTATE),
    "clock_jitter": ("stamps of the arrival of messages jitter", "log the time of measurement"),
    "motor_order": ("motors are in another order", PULSE),
    "motor_spin": ("motors turn the other way round", PULSE),
    "motor_telemetry": (
        "rotor speeds are held, drop out, are copied or late",
        "log them in every row",
    ),
    "motor_dead": ("a motor never turns", PULSE),
    "motor_count": ("not four motors turn", PULSE),
    "motor_unit": ("rotor speeds are in another unit", HOVER),
    "motor_poles": ("eRPM was divided by the wrong number of pole pairs", HOVER),
    "rate_command_unit": ("commanded rates are in another unit", STICKS),
    "rate_command_sign": ("a commanded rate has the other sign", STICKS),
    "rate_curve": ("the firmware maps sticks by another curve", STICKS),
    "command_delay": ("commands act too late", STICKS),
    "controller_rate": ("the controller runs at another rate", FASTER),
    "controller_settings": (
        "the firmware's rate loop has other settings than the vehicle file",
        "",
    ),
    "thrust_command_unit": ("the thrust command is not in m/s^2 along body z", HOVER),
    "throttle_range": ("the throttle is not from 0 to 1", HOVER),
    "throttle_curve": ("thrust grows with the throttle by another curve, or its size", CLIMB),
    "motor_map": ("[motors] of the vehicle file: size or curve of thrust over command", CLIMB),
    "battery_scaling": ("thrust changes with the battery's voltage by another exponent", CLIMB),
    "thrust_scale": ("thrust is not what the vehicle file says", HOVER),
    "voltage": ("the battery's voltage is impossible", "log the battery that drives the motors"),
    "vehicle_mass": ("the mass in the vehicle file is a multiple of the true one", HOVER),
    "vehicle_arms": ("rotors or body are in cm or mm", ""),
    "vehicle_inertia": ("the inertia is another vehicle's or in another unit", ""),
    "vehicle_thrust": ("thrust-to-weight is implausible", ""),
    "vehicle_torque": ("torque over thrust of a rotor is implausible", ""),
    "vehicle_gain": ("gains or limits of the rate loop are in another unit", ""),
    "vehicle_mixed": ("the logs are of several vehicles", ""),
    "camera_fov": ("the policy saw with another camera", ""),
    "file": ("the file is damaged, or of another kind", "log again"),
}
"""Name of a fault -> its description, and the manoeuvre that makes it identifiable."""
