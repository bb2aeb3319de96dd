"""Random frames, frames as python-can's messages and back, and streams cut into pieces."""

import itertools
from contextlib import contextmanager

import can
import numpy as np

from support.processes import repeating
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
    assert all(messages)
    return messages, frames_of(messages)


def cut_at_random(stream, seed):
    """A stream in up to 400 pieces."""
    rng = np.random.default_rng(seed)
    cuts = np.sort(rng.integers(0, len(stream), rng.integers(1, 400)))
    borders = [0, *cuts.tolist(), len(stream)]
    return [stream[start:stop] for start, stop in itertools.pairwise(borders)]


def frames_of(messages):
    """Return messages of python-can as frames, with their times in whole microseconds."""
    frames = fr.empty_frames(len(messages))
    for frame, message in zip(frames, messages, strict=True):
        kind = message.is_extended_id * fr.EXTENDED_FLAG | message.is_error_frame * fr.ERROR_FLAG
        kind |= message.is_remote_frame * fr.REMOTE_FLAG
        frame["id_flags"], frame["dlc"] = message.arbitration_id | kind, message.dlc
        frame["data"] = list(bytes(message.data).ljust(8, b"\0"))
        frame["t_device_ns"] = round(message.timestamp * 1e6) * 1000
    return frames


def identifiers(rng, count):
    """Random identifiers, three in ten of them of 29 bits."""
    wide, narrow = rng.integers(0, 2**29, count) | fr.EXTENDED_FLAG, rng.integers(0, 2**11, count)
    return np.where(rng.random(count) < 0.3, wide, narrow)


def traffic(count, remote_share=0.02):
    """Random frames of both identifier widths and all lengths, a remote request now and then."""
    rng = np.random.default_rng(count)
    frames = fr.empty_frames(count)
    remote = rng.random(count) < remote_share
    frames["id_flags"] = identifiers(rng, count) | (remote * fr.REMOTE_FLAG)
    frames["dlc"] = rng.integers(0, 9, count)
    frames["data"] = rng.integers(0, 256, (count, 8))
    frames["data"][(np.arange(8) >= frames["dlc"][:, None]) | remote[:, None]] = 0
    steps_ns = rng.integers(1, 9000, count) * 1000
    frames["t_device_ns"] = 1_700_000_000_123_456_000 + np.cumsum(steps_ns)
    return frames


def fd_traffic(count):
    """Random CAN FD frames of both identifier widths, all lengths, and some with the fast rate."""
    rng = np.random.default_rng(count)
    frames = fr.empty_fd_frames(count)
    frames["id_flags"] = identifiers(rng, count)
    frames["fd_flags"] = np.where(rng.random(count) < 0.5, fr.FD_BRS, 0)
    lengths = [*range(9), 12, 16, 20, 24, 32, 48, 64]
    frames["len"] = np.array(lengths)[rng.integers(0, 16, count)]
    frames["data"] = rng.integers(0, 256, (count, 64))
    frames["data"][np.arange(64) >= frames["len"][:, None]] = 0
    return frames


def same(frames, truth):
    """Return whether two lots of frames agree in everything but times."""
    classic = truth.dtype == fr.empty_frames(0).dtype
    names = ("id_flags", "dlc", "data") if classic else ("id_flags", "len", "fd_flags", "data")
    return len(frames) == len(truth) and all(np.array_equal(frames[n], truth[n]) for n in names)


@contextmanager
def speaking(channel, speak):
    """Somebody on a virtual bus of python-can, every 10 ms."""
    bus = can.Bus(interface="virtual", channel=channel)
    with bus, repeating(lambda: speak(bus), 0.01):
        yield bus
