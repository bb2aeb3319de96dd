"""Sessions of joints that are commanded and respond, written from arrays."""

import numpy as np

from support.written_topics import EPOCH_NS, write_topics


def write_joints(
    path, names, commands, states=(), *, rate_hz=50, epoch_ns=EPOCH_NS, scenario=None, **options
):
    """Write /joint_commands and /joint_states at a steady rate.

    Args:
        commands: Angles [rad], shape (k, m).
        states: Positions [rad], velocities [rad/s] and efforts [N m], each of shape (k, m); no
            topic without positions.
        scenario: Text to attach as the twin's scenario.
        options: Of :func:`.write_topics`.
    """
    if scenario is not None:
        attached = ("scenario.toml", "application/toml", scenario.encode())
        options |= {"begin": lambda writer: writer.attach(*attached)}
    topics = {"/joint_commands": (names, "rad", commands)}
    if states:
        topics["/joint_states"] = (names, "rad", *states)
    t_ns = epoch_ns + np.arange(len(commands)) * 10**9 // rate_hz
    return write_topics(path, t_ns, topics, epoch_ns=epoch_ns, **{"gaps": False} | options)


def turns(frequency_hz, count, rate_hz=50):
    """Return exp(j omega t) of so many samples, shape (count, 1)."""
    return np.exp(2j * np.pi * frequency_hz * np.arange(count)[:, None] / rate_hz)
