"""Sessions of joint topics that are written tick by tick, every topic at each."""

import numpy as np

from undulog.capture import SessionWriter

EPOCH_NS = 1_735_689_600_000_000_000
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
GAIT = ("horizontal.A", "horizontal.phase")


def write_topics(
    path, t_ns, topics, *, head=None, turn=LEVEL, begin=None, verdict=None, gaps=True, **options
):
    """Write a session and return its path.

    Args:
        t_ns: Unix times of the n ticks [ns].
        topics: Topic to joint names, unit and columns of shape (n, joints) or (n,): position,
            and if there are more, velocity and effort.
        head: The head's positions on ``/odom``, shape (n, 3); nothing is written if None.
        turn: The head's orientation.
        begin: Called with the writer before the first tick.
        verdict: Given at the end.
        gaps: Whether a row of positions without a number is left out.
        options: Of the session's writer.
    """
    options = {"session_id": path.stem, "epoch_ns": EPOCH_NS} | options
    with SessionWriter(path, **options) as writer:
        channels = []
        for topic, (names, unit, *columns) in topics.items():
            more = {"velocity": len(columns) > 1, "effort": len(columns) > 2}
            rows = [np.reshape(column, (-1, len(names))) for column in columns]
            channels.append((writer.joint_state(topic, names, unit=unit, **more), rows))
        if head is not None:
            odometry = writer.odometry("/odom", frame="world", child="link01")
        if begin is not None:
            begin(writer)
        for i, at_ns in enumerate(np.asarray(t_ns).tolist()):
            for channel, columns in channels:
                if not gaps or np.isfinite(columns[0][i]).any():
                    channel.write(at_ns, *(column[i] for column in columns))
            if head is not None:
                odometry.write(at_ns, head[i], turn, np.zeros(3), np.zeros(3))
        if verdict is not None:
            writer.set_verdict(verdict)
    return path
