"""Names of joints in a log, without reading it: of its first messages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

from ...common.errors import DataError, JointSetError, some_names
from ..columns.topics import Topics
from .joint_messages import JOINT_TYPES

_LOOKED_AT = 2000
"""Messages of a topic; one with a message a joint names all its joints in them."""

_MOST_LISTED = 12


def joint_names(topics: Topics, most: int = _LOOKED_AT) -> dict[str, tuple[str, ...]]:
    """Return the joints of each topic that names some, in the order in which they appear.

    Args:
        most: Messages that are looked at of a topic whose messages name one joint each.
    """
    found: dict[str, tuple[str, ...]] = {}
    for topic, channel in topics.channels.items():
        if channel.type_name not in JOINT_TYPES or not channel.is_ros2:
            continue
        try:
            names = _names(topics, topic, most)
        except DataError:  # a damaged schema or message: whoever reads the topic says so
            continue
        if names:
            found[topic] = names
    return found


def _names(topics: Topics, topic: str, most: int) -> tuple[str, ...]:
    decode = topics.decoder(topic)
    names: dict[str, None] = {}
    for _, message in islice(topics.raw(topic), most):
        own = _joints(decode(message))
        names |= dict.fromkeys(own)
        if len(own) > 1:  # all joints in one message
            break
    return tuple(names)


def _joints(message: Any) -> list[str]:
    """Return the joints of a message; of a DynamicJointState those with a position."""
    if hasattr(message, "interface_values"):
        pairs = zip(message.joint_names, message.interface_values, strict=False)
        return [name for name, one in pairs if "position" in one.interface_names]
    return list(getattr(message, "joint_names", None) or getattr(message, "name", ()))


def check_joints(path: Path, topics: Topics, joints: Sequence[str], robot: str) -> None:
    """Hold the joints of a log to those of a robot that is to describe it.

    Raises:
        JointSetError: If they are not the same; names those that only one of them has.
    """
    every: Mapping[str, tuple[str, ...]] = joint_names(topics)
    known = set(joints)
    own = {topic: names for topic, names in every.items() if not known.isdisjoint(names)}
    if not own:
        has = "; ".join(
            f"{topic} has {some_names(names, _MOST_LISTED)}" for topic, names in every.items()
        )
        raise JointSetError(
            f"{path}: none of its joints is of {robot}, which has "
            f"{some_names(joints, _MOST_LISTED)}; {has or 'it has no topic of joints'}"
        )
    logged = dict.fromkeys(name for names in own.values() for name in names)
    strange = [name for name in logged if name not in known]
    missing = [name for name in joints if name not in logged]
    if strange or missing:
        faults = [
            f"{what} {some_names(names, _MOST_LISTED)}"
            for what, names in (("lacks", strange), ("has, but not the log,", missing))
            if names
        ]
        raise JointSetError(
            f"{path}: its joints are not those of {robot}: the description {', and '.join(faults)}"
            " (undulog robot new --from writes one for a log)"
        )
