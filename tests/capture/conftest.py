"""What the tests of sources share: a recording, random bus traffic, and patience."""

import socket
from dataclasses import dataclass, field

import numpy as np
import pytest

from support.processes import wait_for
from undulog.capture import SessionWriter
from undulog.capture.log.messages import frames as fr
from undulog.capture.recorder.status import SessionClock
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
        wait_for(condition, f"{self.counts}, {self.texts}", meanwhile=self.poll)

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
    clock, path = SessionClock(), tmp_path / "session.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=clock.epoch_ns) as writer:
        yield SourceContext(clock.now_ns, writer)


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
