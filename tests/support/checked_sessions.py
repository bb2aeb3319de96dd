"""A clean session, and faults planted in it, for the tests of `undulog log check`."""

import numpy as np
from hostile_logs import EPOCH_NS, joint_state

from support.foreign_logs import foreign_log
from undulog.capture import SessionWriter, load_robot

STEP_NS = 10_000_000
ROBOT = load_robot("snake25")
NAMES = ROBOT.joint_names
TICKS = 2000
JOINT_STATE = "sensor_msgs/msg/JointState"


def gait(tick):
    return 0.4 * np.sin(np.pi * tick / 100 - 0.5 * np.arange(len(NAMES)))


def write(path, edit=None, verdict=None, *, lost=lambda tick: False):
    """Write 20 s of 25 joints at 100 Hz; some states are lost.

    ``edit`` plants faults: it gets tick, command and measured angles [rad], changes them in place,
    and may return another stamp [ns].
    """
    noise = np.random.default_rng(3).normal(0.0, 1e-3, (TICKS, len(NAMES)))
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True)
        for tick in range(TICKS):
            command, angles = gait(tick), gait(tick - 5) + noise[tick]
            stamp_ns = edit and edit(tick, command, angles)
            commands.write(at(tick), command)
            if not lost(tick):
                states.write(stamp_ns or at(tick), angles, command, log_time_ns=at(tick))
        if verdict is not None:
            writer.set_verdict(verdict, ["as the recorder had it"])
    return path


def at(tick):
    return EPOCH_NS + tick * STEP_NS


def timing_of(health, topic="/joint_states"):
    (timing,) = [series.timing for series in health.series if series.topic == topic]
    return timing


def write_raw(path, sequences, **options):
    """Write JointState messages of three joints with given sequence numbers."""
    with foreign_log(path, JOINT_STATE, **options) as (writer, schema):
        for topic in ("/joint_commands", "/joint_states"):
            channel = writer.register_channel(topic, "cdr", schema)
            for k, sequence in enumerate(sequences):
                message = joint_state(at(k), "abc", gait(k)[:3])
                writer.add_message(channel, at(k), message, at(k), sequence)
    return path
