"""Sessions of raw frames, and the frames of one that was imported."""

from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.exchange.can_import import import_can

T0 = 1_700_000_003_250_000_000


def write_frames(path, topics, batch=37, **metadata):
    """Write frames by topic, classic or CAN FD by its name."""
    with SessionWriter(path, session_id="s-1", epoch_ns=T0, metadata=metadata) as writer:
        messages = [
            (int(frames["t_host_ns"][start : start + batch].max()), topic, start)
            for topic, frames in topics.items()
            for start in range(0, len(frames), batch)
        ]
        channels = {
            topic: writer.fd_frames(topic) if "_fd/" in topic else writer.frames(topic)
            for topic in topics
        }
        for log_ns, topic, start in sorted(messages, key=lambda message: message[0]):
            channels[topic].write(log_ns, topics[topic][start : start + batch])
    return path


def imported(trace, folder, topic="/can/can0"):
    """Import a trace; return the report, and the frames of a topic of the session."""
    run = folder / "back.mcap"
    report = import_can(trace, run, load_robot("snake13"), force=True)
    with Session.open(run) as session:
        read = session.fd_frames if "_fd/" in topic else session.frames
        return report, read(topic)
