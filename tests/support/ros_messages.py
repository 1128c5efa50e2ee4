"""Definitions of the ROS 2 messages that test recordings hold (ros2 interface show)."""

PARTS = {
    "std_msgs/Header": "builtin_interfaces/Time stamp, string frame_id",
    "builtin_interfaces/Time": "int32 sec, uint32 nanosec",
    "geometry_msgs/Vector3": "float64 x, float64 y, float64 z",
    "geometry_msgs/Point": "float64 x, float64 y, float64 z",
    "geometry_msgs/Quaternion": "float64 x, float64 y, float64 z, float64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position, geometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose, float64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear, geometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist, float64[36] covariance",
}


def fields(*each):
    """Return a message's definition, which begins with a header, without those of its parts."""
    return "".join(f"{field}\n" for field in ("std_msgs/Header header", *each))


DEFINITIONS = "".join(
    f"{'=' * 80}\nMSG: {name}\n{parts.replace(', ', chr(10))}\n" for name, parts in PARTS.items()
)
ODOMETRY = fields(
    "string child_frame_id",
    "geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/TwistWithCovariance twist",
)
IMU = fields(
    "geometry_msgs/Quaternion orientation",
    "float64[9] orientation_covariance",
    "geometry_msgs/Vector3 angular_velocity",
    "float64[9] angular_velocity_covariance",
    "geometry_msgs/Vector3 linear_acceleration",
    "float64[9] linear_acceleration_covariance",
)
TARGET = fields(
    "uint8 type_mask",
    "geometry_msgs/Quaternion orientation",
    "geometry_msgs/Vector3 body_rate",
    "float32 thrust",
)
ACTUATORS = fields("float64[] position", "float64[] velocity", "float64[] normalized")
