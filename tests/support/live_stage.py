"""Recorders that send sessions, and relays, for the tests of the live view."""

import json
import sys

import numpy as np
from mcap.reader import make_reader

from support.processes import start, wait_for
from undulog.capture.recorder.live_feed import LiveFeed

EPOCH_NS = 1_735_689_600_000_000_000
STEP_NS = 20_000_000
WAIT_S = 90


class Recorder:
    """Sends a session's messages, as a recorder would, but as fast as the relay takes them."""

    def __init__(self, session, socket_path, **options):
        with session.open("rb") as stream:
            reader = make_reader(stream)
            summary = reader.get_summary()
            self.definitions = [
                *reader.iter_metadata(),
                *summary.schemas.values(),
                *summary.channels.values(),
                *reader.iter_attachments(),
            ]
            self.messages = [
                (m.channel_id, m.log_time, m.publish_time, m.sequence, m.data)
                for _, _, m in reader.iter_messages()
            ]
        self.feed = LiveFeed(socket_path, **options)
        for definition in self.definitions:
            self.feed.define(definition)

    def connect(self):
        wait_for(lambda: self.feed.connected, meanwhile=self.feed.pump)

    def send(self, start_s=0.0, stop_s=np.inf, *, wait=True):
        """Send the messages of a time interval; return the number of ticks."""
        ticks, at_ns = 0, EPOCH_NS
        for message in self.messages:
            if not start_s <= (message[1] - EPOCH_NS) * 1e-9 < stop_s:
                continue
            if message[1] >= at_ns + STEP_NS:
                at_ns = message[1]
                self.feed.pump()
                ticks += 1
                if wait:
                    wait_for(lambda: self.feed.queued == 0, meanwhile=self.feed.pump)
            self.feed.offer(*message)
        if wait:
            wait_for(lambda: self.feed.queued == 0, meanwhile=self.feed.pump)
        return ticks

    def send_all(self):
        """Send all messages, and end."""
        self.connect()
        self.send()
        self.feed.close()


def seen_live(session, folder):
    """Record and relay a session to a file; return the report of the relay, and the file."""
    relay = Relay(folder / "live.sock", folder / "live.rrd")
    try:
        Recorder(session, folder / "live.sock").send_all()
        return relay.finish(), relay.output
    finally:
        relay.process.kill()
        relay.process.communicate()


class Relay:
    """The command in a process of its own."""

    def __init__(self, socket_path, output, *more):
        self.output = output
        command = [sys.executable, "-m", "undulog", "view", "--live", socket_path]
        if output is not None:
            command += ["--save", output, "--json", "--force"]
        self.process = start(*command, *more)
        wait_for(lambda: socket_path.is_socket() or self.process.poll() is not None)

    def finish(self):
        out, err = self.process.communicate(timeout=WAIT_S)
        assert self.process.returncode == 0, err
        return json.loads(out)
