"""Topics that speak only when something changes: their last message stays in force."""

from __future__ import annotations

import re

from mcap.records import Channel

_LATCHED = re.compile(r"durability:\s*(1\b|transient_local)")


def is_latched(type_name: str, channel: Channel) -> bool:
    """Whether a topic's last message stays in force until the next.

    A String, static transforms, or what a ROS 2 recorder noted as durability transient local
    (``offered_qos_profiles``, https://github.com/ros2/rosbag2).

    Args:
        type_name: The messages' type.
        channel: The channel.

    Returns:
        True for those.
    """
    if type_name == "std_msgs/msg/String":
        return True
    offered = channel.metadata.get("offered_qos_profiles", "")
    return adds_up(channel) or bool(_LATCHED.search(offered))


def adds_up(channel: Channel) -> bool:
    """Whether every different message stays in force, not only the last.

    Args:
        channel: The channel.

    Returns:
        True for static transforms: each message holds some of them.
    """
    return channel.topic.endswith("/tf_static")
