"""Sessions of joints that are commanded and respond, written from arrays."""

import numpy as np

from undulog.capture import SessionWriter

EPOCH_NS = 1_735_689_600_000_000_000


def write_joints(
    path,
    names,
    commands,
    states=(),
    *,
    rate_hz=50,
    epoch_ns=EPOCH_NS,
    scenario=None,
    more=(),
    **options,
):
    """Write /joint_commands and /joint_states at a steady rate.

    Args:
        commands: Angles [rad], shape (k, m).
        states: Positions [rad], velocities [rad/s] and efforts [N m], each of shape (k, m); no
            topic without positions.
        scenario: Text to attach as the twin's scenario.
        options: Of the session's writer.
    """
    options = {"session_id": path.stem, **options}
    with SessionWriter(path, epoch_ns=epoch_ns, **options) as writer:
        if scenario is not None:
            writer.attach("scenario.toml", "application/toml", scenario.encode())
        channels = [(writer.joint_state("/joint_commands", names, unit="rad"), [commands])]
        if states:
            parts = {"velocity": len(states) > 1, "effort": len(states) > 2}
            channels.append(
                (writer.joint_state("/joint_states", names, unit="rad", **parts), states)
            )
        for k in range(len(commands)):
            for channel, fields in channels:
                channel.write(epoch_ns + k * 10**9 // rate_hz, *(one[k] for one in fields))
    return path


def turns(frequency_hz, count, rate_hz=50):
    """Return exp(j omega t) of so many samples, shape (count, 1)."""
    return np.exp(2j * np.pi * frequency_hz * np.arange(count)[:, None] / rate_hz)
