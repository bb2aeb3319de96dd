"""Sessions of raw frames, and the frames of one that was imported."""

from itertools import product

import can
import numpy as np
from can.util import CAN_FD_DLC

from support.imported import import_can
from undulog.capture import Session, SessionWriter, load_robot
from undulog.capture.log.messages import frames as fr

T0 = 1_700_000_003_250_000_000
IDENTIFIERS = (0, 0x14B, 0x7FF, fr.EXTENDED_FLAG, fr.EXTENDED_FLAG | 0x1FFF_FFFF)


def every_kind(*, fd=False, start_ns=T0, step_ns=1_000_000):
    """Each identifier, kind, way, length and flag that CAN or CAN FD has, one frame a step."""
    rng = np.random.default_rng(3)
    errors = (0x80 | fr.ERROR_FLAG, 0x1FFF_FFFF | fr.ERROR_FLAG)
    remote = [i | fr.REMOTE_FLAG for i in IDENTIFIERS]
    identifiers = IDENTIFIERS if fd else (*IDENTIFIERS, *remote, *errors)
    lengths = CAN_FD_DLC if fd else range(9)
    flags = (0, fr.FD_BRS, fr.FD_ESI, fr.FD_BRS | fr.FD_ESI) if fd else (0,)
    kinds = list(product(identifiers, (fr.DIR_RX, fr.DIR_TX), lengths, flags))
    frames = fr.empty_fd_frames(len(kinds)) if fd else fr.empty_frames(len(kinds))
    for frame, (id_flags, way, length, fd_flags) in zip(frames, kinds, strict=True):
        frame["id_flags"], frame["dir"], frame["len" if fd else "dlc"] = id_flags, way, length
        if fd:
            frame["fd_flags"] = fd_flags
        if not id_flags & fr.REMOTE_FLAG:
            frame["data"][:length] = list(rng.bytes(length))
    frames = frames[rng.permutation(len(frames))]
    frames["t_host_ns"] = start_ns + step_ns * np.arange(len(frames))
    return frames


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


def frames_of(path, topic="/can/can0"):
    with Session.open(path) as session:
        return (session.fd_frames if "_fd/" in topic else session.frames)(topic)


def imported(trace, folder, topic="/can/can0"):
    """Import a trace; return the report, and the frames of a topic of the session."""
    report = import_can(trace, folder / "back.mcap", load_robot("snake13"), force=True)
    return report, frames_of(report.output, topic)


def log_messages(path, messages, **options):
    """Write a log by python-can's writer for its suffix."""
    with can.Logger(str(path), **options) as writer:
        for message in messages:
            writer(message)
    return path
