"""Sessions by the session writer and by mcap-ros2-support."""

import itertools

import numpy as np
from mcap_ros2.writer import Writer as RosWriter

from undulog.capture import SessionWriter
from undulog.capture.log.messages.definitions import schema_text

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
NAMES = ("joint01", "joint02", "joint03")
JOINT_STATE = "sensor_msgs/msg/JointState"


def samples(count=300):
    return np.random.default_rng(7).normal(size=(count, 3, len(NAMES)))


def write_session(path, count=300, **options):
    data = samples(count)
    with SessionWriter(path, session_id="s1", epoch_ns=EPOCH_NS, **options) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True, effort=True)
        odometry = writer.odometry("/odom", frame="world", child="link01")
        events = writer.log("/rosout")
        writer.string("/gait/mode").write(EPOCH_NS, "walk")
        events.write(EPOCH_NS, "warn", "twin", "clamped")
        for tick, (position, velocity, effort) in enumerate(data):
            t_ns = EPOCH_NS + tick * STEP_NS
            commands.write(t_ns, position)
            states.write(t_ns, position, velocity, effort)
            odometry.write(t_ns, position, np.array([0, 0, 0, 1.0]), velocity, effort)
        writer.set_verdict("good", ["nothing lost"])
    return data


def write_commands(path, names, commands, *, times_ns=None, plan=None, **options):
    """Write a session of joint commands and nothing else.

    Args:
        commands: Angles of each tick [rad].
        times_ns: When they were given, after the start [ns]; 10 ms apart if None.
        plan: The record of the plan that they are from.
        options: Of the session's writer.
    """
    with SessionWriter(path, session_id="commands", epoch_ns=EPOCH_NS, **options) as writer:
        if plan is not None:
            writer.note("undulog.plan", plan)
        channel = writer.joint_state("/joint_commands", names, unit="rad")
        for t_ns, command in zip(times_ns or itertools.count(0, STEP_NS), commands, strict=False):
            channel.write(EPOCH_NS + t_ns, command)
        writer.set_verdict("good")
    return path


def write_foreign(path, messages, type_name=JOINT_STATE):
    """Write messages (topic, log time, content) by mcap-ros2-support."""
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(type_name, schema_text(type_name))
        for topic, t_ns, content in messages:
            writer.write_message(topic, schema, content, log_time=t_ns, publish_time=t_ns)
        writer.finish()
    return path


def joint_state(t_ns, names, position, **more):
    stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
    return {"header": {"stamp": stamp}, "name": names, "position": position, **more}
