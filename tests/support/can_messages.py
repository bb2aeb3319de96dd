"""Frames as python-can's messages and back, and streams cut into pieces."""

import itertools

import can
import numpy as np

from undulog.capture.log.messages import frames as fr


def can_message(frame, **options):
    """A frame, classic or CAN FD, as a message of python-can."""
    flags = int(frame["id_flags"])
    fields = {
        "arbitration_id": flags & fr.ID_MASK,
        "is_extended_id": bool(flags & fr.EXTENDED_FLAG),
        "timestamp": int(frame["t_device_ns"]) / 1e9,
        "check": True,
    }
    if "len" in frame.dtype.names:
        fields["is_fd"] = True
        fields["bitrate_switch"] = bool(frame["fd_flags"] & fr.FD_BRS)
        fields["error_state_indicator"] = bool(frame["fd_flags"] & fr.FD_ESI)
        fields["data"] = frame["data"][: frame["len"]].tolist()
    else:
        remote = bool(flags & fr.REMOTE_FLAG)
        fields["is_remote_frame"], fields["dlc"] = remote, int(frame["dlc"])
        fields["is_error_frame"] = bool(flags & fr.ERROR_FLAG)
        fields["data"] = None if remote else frame["data"][: frame["dlc"]].tolist()
    return can.Message(**fields | options)


def received(bus, count):
    """The next messages of a bus of python-can, and the frames in them."""
    messages = [bus.recv(60) for _ in range(count)]
    bus.shutdown()
    assert all(messages)
    frames = fr.empty_frames(count)
    frames["id_flags"] = [
        m.arbitration_id | m.is_extended_id * fr.EXTENDED_FLAG | m.is_remote_frame * fr.REMOTE_FLAG
        for m in messages
    ]
    frames["dlc"] = [m.dlc for m in messages]
    frames["data"] = [list(bytes(m.data).ljust(8, b"\0")) for m in messages]
    return messages, frames


def cut_at_random(stream, seed):
    """A stream in up to 400 pieces."""
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, len(stream), rng.integers(1, 400)))
    borders = [0, *cuts.tolist(), len(stream)]
    return [stream[start:stop] for start, stop in itertools.pairwise(borders)]


def frames_of(messages):
    """Return messages of python-can as frames, with the robot's times in whole microseconds."""
    frames = fr.empty_frames(len(messages))
    for frame, message in zip(frames, messages, strict=True):
        kind = message.is_extended_id * fr.EXTENDED_FLAG | message.is_error_frame * fr.ERROR_FLAG
        frame["id_flags"], frame["dlc"] = message.arbitration_id | kind, message.dlc
        frame["data"][: message.dlc] = list(message.data)
        frame["t_device_ns"] = round(message.timestamp * 1e6) * 1000
    return frames
