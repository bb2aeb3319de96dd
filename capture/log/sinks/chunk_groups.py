"""Which channels of a session share chunks.

The topics that carry nearly all of a session's bytes have chunks of their own: to read the joint
states of ten seconds, nothing else is decompressed, and messages of one type side by side compress
better. The rest is so little that it shares chunks: each on its own, it would be written in crumbs.
"""

from __future__ import annotations

_BULKY = frozenset(
    {"sensor_msgs/msg/JointState", "std_msgs/msg/UInt8MultiArray", "tf2_msgs/msg/TFMessage"}
)


def chunk_group(topic: str, type_name: str) -> str:
    """The group of a channel; those of one group share chunks.

    Args:
        topic: Its topic.
        type_name: Its message type, e.g. ``sensor_msgs/msg/Imu``.

    Returns:
        A name; empty for the channels that share what is left.
    """
    return topic if type_name in _BULKY else ""
