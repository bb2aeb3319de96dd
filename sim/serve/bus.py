"""One bus with a robot on it: everyone hears every frame that somebody else sent."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence

from undulog.capture.common.errors import UsageError
from undulog.capture.log.messages.frames import FrameArray, empty_frames
from undulog.capture.sources.records import records
from undulog.capture.sources.sender import FrameSender

from .bus_client import Sent
from .socketcand_server import SocketcandServer

_LONGEST_WAIT_S = 0.05


class VirtualBus:
    """The bus over loopback: clients of a socketcand server, and a recorder's socket.

    Attributes:
        sent: Frames that the robot sent.
        heard: Frames that clients sent.
    """

    def __init__(
        self,
        server: SocketcandServer | None,
        sender: FrameSender | None,
        say: Callable[[str, str], None],
    ) -> None:
        """Put the bus together.

        Args:
            server: Where clients listen and send, or None.
            sender: The way to a recorder, or None; it does not have to be there yet.
            say: Told what happens: level, text.

        Raises:
            UsageError: If the recorder's socket can never be used.
        """
        self.sent = self.heard = 0
        self._server, self._sender, self._say = server, sender, say
        self._recorder = False
        if sender is not None:
            try:
                sender.send(empty_frames(0))
            except OSError as error:
                raise UsageError(f"{sender.path}: {error.strerror or error}") from error

    @property
    def waiting(self) -> int:
        """Frames that clients sent and nobody has pulled yet."""
        return 0 if self._server is None else self._server.waiting

    def identify(self, identity: str) -> None:
        """Say what clients are told that ask.

        Args:
            identity: E.g. ``virtual-robot snake25 paced``.
        """
        if self._server is not None:
            self._server.identity = identity

    def mark(self, tick: int, state: FrameArray | None = None) -> None:
        """Tell clients that asked for it that all frames of a control tick are out.

        Args:
            tick: Its number.
            state: The newest frames of the robot's state, for those who come later; None where they
                soon hear newer ones.
        """
        if self._server is not None:
            self._server.mark(tick, state)

    def wait(self, timeout_s: float) -> None:
        """Serve the clients until something happens.

        Args:
            timeout_s: How long to wait at most [s]; a twentieth of a second in any case.
        """
        timeout_s = min(timeout_s, _LONGEST_WAIT_S)
        if self._sender is not None:
            self._record(empty_frames(0))
        if self._server is None:
            time.sleep(timeout_s)
        else:
            self._server.pump(timeout_s)

    def pull(self, most: int | None = None) -> list[Sent]:
        """Take frames that clients sent, the oldest first.

        Args:
            most: How many at most.

        Returns:
            The frames; nobody else has heard them yet, see :meth:`relay`.
        """
        if self._server is None:
            return []
        taken = iter(self._server.take, None)
        return list(itertools.islice(taken, most))

    def relay(self, sent: Sequence[Sent], t_ns: int) -> FrameArray:
        """Let everyone but their senders hear frames of clients.

        Args:
            sent: What was pulled.
            t_ns: The robot's clock [ns]: their time on the bus.

        Returns:
            The frames, marked as sent by the robot's computer.
        """
        frames = records(each.record for each in sent)
        frames["t_device_ns"] = t_ns
        self.heard += len(frames)
        start = 0
        for client, group in itertools.groupby(each.client for each in sent):
            stop = start + len(list(group))
            self._give(frames[start:stop], client)
            start = stop
        return frames

    def send(self, frames: FrameArray) -> None:
        """Let everyone hear frames of the robot.

        Args:
            frames: Records of :data:`.FRAME_DTYPE` with device times, (n,).
        """
        self.sent += len(frames)
        self._give(frames, None)

    def close(self) -> None:
        """End all connections; safe to call twice."""
        if self._server is not None:
            self._server.close()
        if self._sender is not None:
            self._sender.close()

    def _give(self, frames: FrameArray, client: int | None) -> None:
        if self._server is not None:
            self._server.broadcast(frames, but=client)
        self._record(frames)

    def _record(self, frames: FrameArray) -> None:
        """Hand frames to the recorder, and say so when it comes or goes."""
        if self._sender is None:
            return
        try:
            self._sender.send(frames)
        except OSError as error:
            self._say("error", f"{self._sender.path} is given up: {error.strerror or error}")
            self._sender = None
            return
        if self._sender.connected is not self._recorder:
            self._recorder = self._sender.connected
            there = "a recorder listens" if self._recorder else "the recorder is gone"
            self._say("info", f"{there} at {self._sender.path}")
