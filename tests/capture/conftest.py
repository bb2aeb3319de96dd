"""What the tests of sources share: a recording, random bus traffic, and patience."""

import socket
import time
from dataclasses import dataclass, field

import numpy as np
import pytest

from support.processes import wait_for
from undulog.capture import SessionWriter
from undulog.capture.log.messages import frames as fr
from undulog.capture.sources.contract import Source, SourceContext, SourceEvent


@dataclass
class Reader:
    """What a source gave: frames in order, events in order."""

    source: Source
    arrays: list[fr.FrameArray] = field(default_factory=list)
    events: list[SourceEvent] = field(default_factory=list)
    fd_arrays: list[fr.FrameArray] = field(default_factory=list)

    def poll(self):
        polled = self.source.poll()
        self.arrays += polled.frames
        self.fd_arrays += polled.fd_frames
        self.events += polled.events

    def until(self, condition):
        """Poll until something is so; fails after a long time."""
        wait_for(condition, f"{self.counts}, {self.texts}", each=self.poll)

    def until_frames(self, count):
        self.until(lambda: sum(map(len, self.arrays)) >= count)
        self.poll()
        return self.frames

    def until_event(self, part):
        self.until(lambda: any(part in event.text for event in self.events))
        return next(event for event in self.events if part in event.text)

    @property
    def frames(self):
        return np.concatenate([fr.empty_frames(0), *self.arrays])

    @property
    def fd_frames(self):
        return np.concatenate([fr.empty_fd_frames(0), *self.fd_arrays])

    @property
    def counts(self):
        return self.source.counts

    @property
    def texts(self):
        return [event.text for event in self.events]


@pytest.fixture
def context(tmp_path):
    """A recording that has begun."""
    epoch_ns, start_ns = time.time_ns(), time.monotonic_ns()
    path = tmp_path / "session.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=epoch_ns) as writer:
        yield SourceContext(lambda: epoch_ns + time.monotonic_ns() - start_ns, writer)


@pytest.fixture
def listen(context):
    """Start a source; it is stopped at the end, whatever happens."""
    started = []

    def start(source):
        started.append(source)
        source.start(context)
        return Reader(source)

    yield start
    for source in started:
        source.stop()
        source.stop()  # safe to call twice


@pytest.fixture
def sockets():
    """A bound datagram socket and one connected to it."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as theirs,
    ):
        ours.bind(("127.0.0.1", 0))
        theirs.connect(ours.getsockname())
        yield ours, theirs


def identifiers(rng, count):
    """Random identifiers, three in ten of them of 29 bits."""
    wide, narrow = rng.integers(0, 2**29, count) | fr.EXTENDED_FLAG, rng.integers(0, 2**11, count)
    return np.where(rng.random(count) < 0.3, wide, narrow)


@pytest.fixture
def traffic():
    """Random frames of both identifier widths and all lengths, a remote request now and then."""

    def make(count):
        rng = np.random.default_rng(count)
        frames = fr.empty_frames(count)
        remote = rng.random(count) < 0.02
        frames["id_flags"] = identifiers(rng, count) | (remote * fr.REMOTE_FLAG)
        frames["dlc"] = rng.integers(0, 9, count)
        frames["data"] = rng.integers(0, 256, (count, 8))
        frames["data"][(np.arange(8) >= frames["dlc"][:, None]) | remote[:, None]] = 0
        steps_ns = rng.integers(1, 9000, count) * 1000
        frames["t_device_ns"] = 1_700_000_000_123_456_000 + np.cumsum(steps_ns)
        return frames

    return make


@pytest.fixture
def fd_traffic():
    """Random CAN FD frames of both identifier widths, all lengths, and some with the fast rate."""

    def make(count):
        rng = np.random.default_rng(count)
        frames = fr.empty_fd_frames(count)
        frames["id_flags"] = identifiers(rng, count)
        frames["fd_flags"] = np.where(rng.random(count) < 0.5, fr.FD_BRS, 0)
        lengths = [*range(9), 12, 16, 20, 24, 32, 48, 64]
        frames["len"] = np.array(lengths)[rng.integers(0, 16, count)]
        frames["data"] = rng.integers(0, 256, (count, 64))
        frames["data"][np.arange(64) >= frames["len"][:, None]] = 0
        return frames

    return make


@pytest.fixture
def same():
    """Whether two lots of frames agree in everything but times."""

    def compare(found, truth):
        classic = truth.dtype == fr.empty_frames(0).dtype
        names = ("id_flags", "dlc", "data") if classic else ("id_flags", "len", "fd_flags", "data")
        return len(found) == len(truth) and all(np.array_equal(found[n], truth[n]) for n in names)

    return compare
