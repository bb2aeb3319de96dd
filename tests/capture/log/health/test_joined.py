"""One loss is one reason, on however many joints and channels; two losses are two."""

from itertools import product

import numpy as np
import pytest
from hostile_logs import EPOCH_NS, joint_state

from support.foreign_logs import foreign_log
from undulog.capture.log.health.findings import ChannelFault, joined, listed
from undulog.capture.log.health.session_check import check_session

JOINT_STATE = "sensor_msgs/msg/JointState"
JOINTS = tuple(f"j{k}" for k in range(1, 13))
TOPICS = ("/joint_states", "/joint_current", "/joint_temperature")
TICKS = 400


def lost(path, *, of_topic=None, whole=True, servos=False):
    """20 s at 20 Hz; in each topic a cycle is lost, or its numbers: 200, or ``of_topic``'s."""
    with foreign_log(path, JOINT_STATE) as (writer, schema):
        topics = (*TOPICS, "/joint_commands")
        channels = {topic: writer.register_channel(topic, "cdr", schema) for topic in topics}
        groups = [[name] for name in JOINTS] if servos else [list(JOINTS)]
        for tick, topic, names in product(range(TICKS), topics, groups):
            gone = topic in TOPICS and tick == (of_topic or {}).get(topic, 200)
            if gone and whole:
                continue
            t_ns = EPOCH_NS + tick * 50_000_000
            values = 0.4 * np.sin(0.1 * tick - np.arange(len(names)))
            message = joint_state(t_ns, names, values * (np.nan if gone else 1.0))
            writer.add_message(channels[topic], t_ns, message, t_ns, 0)
    return check_session(path)


@pytest.mark.slow
@pytest.mark.parametrize("servos", [False, True])
@pytest.mark.parametrize("whole", [False, True])
def test_one_lost_bus_cycle_is_one_reason(tmp_path, whole, servos):
    health = lost(tmp_path / "s.mcap", whole=whole, servos=servos)
    (reason,) = health.reasons
    assert health.verdict == "degraded"
    assert all(topic in reason for topic in TOPICS) or servos
    assert ("1 samples missing (0.25%)" if whole else "1 of 400 samples") in reason
    assert "/joint_commands" not in reason


def test_losses_at_two_times_are_two_reasons(tmp_path):
    apart, together = sorted(lost(tmp_path / "s.mcap", of_topic={"/joint_current": 300}).reasons)
    gap = "1 gaps, 1 samples missing (0.25%); the longest is 0.1 s"
    assert apart.startswith(f"/joint_current: {gap}")
    both = "/joint_states and /joint_temperature, lost together"
    assert together.startswith(f"{both}: at most 1 gaps")


def test_the_figures_are_those_of_the_worst():
    gap = (5 * 10**9, 6 * 10**9)
    later = (gap[0] + 10**8, gap[1] + 10**8)
    faults = [
        ChannelFault(1, "/a", "", "1 of it", 1, gap, 0.01),
        ChannelFault(1, "/b", "", "9 of it", 1, later, 0.09),
        ChannelFault(0, "/c", "", "a note", 1, gap, 0.001),
        ChannelFault(1, "/d", "", "two gaps", 2, gap, 0.02),
    ]
    assert [(reason.weight, reason.sentence) for reason in joined(faults)] == [
        (1, "/a and /b, lost together: at most 9 of it"),
        (0, "/c: a note"),
        (1, "/d: two gaps"),
    ]


def test_joints_that_differ_have_reasons_of_their_own():
    faults = [
        ChannelFault(1, topic, name, f"{3 if name == 'j2' else 1} of 400")
        for topic in ("/x", "/y")
        for name in ("j1", "j2", "j3")
    ]
    assert [reason.sentence for reason in joined(faults)] == [
        "/x and /y, j1 and j3, each: 1 of 400",
        "/x and /y, j2, each: 3 of 400",
    ]


def test_long_lists_are_cut():
    assert listed(["a"]) == "a"
    assert listed(list("abcdefgh")) == "a, b, c, d, e, f, g and h"
    assert listed(list("abcdefghi")) == "a, b, c, d, e, f, g and 2 more"
