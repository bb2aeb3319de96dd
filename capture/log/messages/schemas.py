"""Definitions of the ROS 2 messages that the log contract uses.

Fields as in ros2/common_interfaces and ros2/rcl_interfaces (Rolling); comments are left out.
"""

from __future__ import annotations

from functools import cache

from ...common.errors import DataError
from .rosmsg import PRIMITIVES, MessageType, parse_message_type

JOINT_STATE = "sensor_msgs/msg/JointState"

_BODIES: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "std_msgs/String": "string data\n",
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride\n",
    "std_msgs/MultiArrayLayout": "MultiArrayDimension[] dim\nuint32 data_offset\n",
    "std_msgs/UInt8MultiArray": "MultiArrayLayout layout\nuint8[] data\n",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation\n",
    "geometry_msgs/Twist": "Vector3 linear\nVector3 angular\n",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance\n",
    "geometry_msgs/TwistWithCovariance": "Twist twist\nfloat64[36] covariance\n",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation\n",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\nTransform transform\n"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\n"
        "float64[] position\nfloat64[] velocity\nfloat64[] effort\n"
    ),
    "sensor_msgs/Range": (
        "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\nuint8 radiation_type\n"
        "float32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n"
        "float32 variance\n"
    ),
    "sensor_msgs/Imu": (
        "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
        "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
        "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
        "float64[9] linear_acceleration_covariance\n"
    ),
    "sensor_msgs/MagneticField": (
        "std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n"
        "float64[9] magnetic_field_covariance\n"
    ),
    "sensor_msgs/TimeReference": (
        "std_msgs/Header header\nbuiltin_interfaces/Time time_ref\nstring source\n"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value\n",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
        "byte level\nstring name\nstring message\nstring hardware_id\nKeyValue[] values\n"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\nDiagnosticStatus[] status\n",
    "rcl_interfaces/Log": (
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\n"
        "string function\nuint32 line\n"
    ),
}


@cache
def schema_text(name: str) -> str:
    """The ``ros2msg`` schema of a message type, dependencies appended.

    Args:
        name: Full name, e.g. ``sensor_msgs/msg/JointState``.

    Returns:
        The text for an MCAP schema record.

    Raises:
        DataError: If the log contract doesn't use that type.
    """
    short = name.replace("/msg/", "/")
    if short not in _BODIES:
        listed = ", ".join(sorted(_BODIES))
        raise DataError(f"no definition of {name}; there are {listed}")
    order: list[str] = []
    _collect(short, order)
    parts = [_BODIES[order[0]], *(f"MSG: {dep}\n{_BODIES[dep]}" for dep in order[1:])]
    return ("=" * 80 + "\n").join(parts)


@cache
def message_type(name: str) -> MessageType:
    """The parsed type of the same name.

    Args:
        name: Full name, e.g. ``sensor_msgs/msg/JointState``.

    Returns:
        The type.

    Raises:
        DataError: If the log contract doesn't use that type.
    """
    return parse_message_type(name, schema_text(name))


def _collect(short: str, order: list[str]) -> None:
    """Append a type and all it needs, each once, main type first."""
    order.append(short)
    for line in _BODIES[short].splitlines():
        base = line.split()[0].partition("[")[0]
        if base in PRIMITIVES or base == "string":
            continue
        dependency = base if "/" in base else f"{short.partition('/')[0]}/{base}"
        if dependency not in order:
            _collect(dependency, order)
