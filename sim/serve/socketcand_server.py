"""A socketcand server for one bus, on loopback only: several clients, none of whom can block it.

Protocol: https://github.com/linux-can/socketcand, ``doc/protocol.md``. Of its modes there is the
raw one, in which a client gets every frame that it did not send itself; frames can be sent in the
default mode too. One message is not socketcand's: a client that sends ``< undulog >`` is told what
is served, ``< undulog virtual-robot NAME PACE >``, and from then on gets ``< tick N >`` after the
frames of each control tick; before the first one that it gets, the newest state of the robot.

What a client can't take at once waits in a queue of its own. A queue that is full ends the
connection: on a bus nobody waits for a listener.
"""

from __future__ import annotations

import itertools
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence

from undulog.capture.common.errors import UsageError
from undulog.capture.log.messages.frames import FrameArray, empty_frames
from undulog.capture.sources.contract import records
from undulog.capture.sources.unix_socket import FrameSender

from .pacing import listen_on_loopback
from .socketcand_protocol import BusClient, Sent, frame_text, sent_frame

MOST_CLIENTS = 16
"""Clients at once. One more takes the place of the one outside raw mode that is silent longest."""
MOST_BYTES = 1 << 20
"""What waits for one client, at most: some ten seconds of a robot of 25 joints."""
MOST_SENT = 10_000
"""Frames that clients sent and the robot has not taken yet; from there on clients have to wait."""
HOLD_S = 0.05
"""A client that goes to raw mode gets its first frames this much later: python-can's takes what
comes with the answer for part of it."""

_CHUNK = 1 << 14
_UNSUPPORTED = ("add", "update", "delete", "subscribe", "unsubscribe", "filter", "muxfilter")
_SEND = ("send", "sendrtr")

_LONGEST_WAIT_S = 0.05


class SocketcandServer:
    """Serves one bus.

    Attributes:
        dropped: Clients whose connection was ended because they were too slow or made no sense.
        identity: Answer to clients that request the robot's identity.
    """

    def __init__(
        self, host: str, port: int, bus: str, log_event: Callable[[str, str], None]
    ) -> None:
        """Listen.

        Args:
            host: A name or address of the loopback interface.
            port: TCP port; 0 for any that is free.
            bus: Name of the bus, e.g. ``can0``.
            say: Told what happens: level, text.

        Raises:
            UsageError: If the host is not loopback, or nobody can listen there.
        """
        self.dropped = 0
        self.identity = ""
        self._tick: int | None = None
        self._state = b""
        self._bus, self._say = bus, log_event
        self._clients: dict[int, BusClient] = {}
        self._number = 0
        self._sent: deque[Sent] = deque()
        self._selector = selectors.DefaultSelector()
        self._listener = listen_on_loopback(host, port)
        self._selector.register(self._listener, selectors.EVENT_READ)

    @property
    def address(self) -> tuple[str, int]:
        """Where it listens: address and port."""
        host, port = self._listener.getsockname()[:2]
        return host, port

    @property
    def waiting(self) -> int:
        """Frames that clients sent and nobody has taken yet."""
        return len(self._sent)

    def pump(self, timeout_s: float) -> None:
        """Wait until something happens, and take and give what there is.

        Args:
            timeout_s: How long to wait at most [s].
        """
        now = time.monotonic()
        held = [client.held_until - now for client in self._clients.values() if client.out]
        waits = [wait for wait in held if wait > 0]
        for key, mask in self._selector.select(max(0.0, min([timeout_s, *waits]))):
            client: BusClient | None = key.data
            if client is None:
                self._accept()
                continue
            if mask & selectors.EVENT_READ and client.number in self._clients:
                self._read(client)
            if mask & selectors.EVENT_WRITE and client.number in self._clients:
                self._write(client)
        if held:  # the selector can't tell when a hold is over
            for client in [client for client in self._clients.values() if client.out]:
                self._write(client)

    def take(self) -> Sent | None:
        """The oldest frame that a client sent and nobody has taken; None where there is none."""
        if not self._sent:
            return None
        sent = self._sent.popleft()
        if len(self._sent) == MOST_SENT - 1:
            for client in self._clients.values():
                self._watch(client)
        return sent

    def broadcast(self, frames: FrameArray, but: int | None = None) -> None:
        """Give frames to every client in raw mode.

        Args:
            frames: Records of :data:`.FRAME_DTYPE`, shape (n,); their device
                times are sent.
            but: Number of the client that sent them.
        """
        listening = [c for c in self._clients.values() if c.raw and c.number != but]
        if not len(frames) or not listening:
            return
        text = frame_text(frames)
        for client in listening:
            self._give(client, text)

    def mark(self, tick: int, state: FrameArray | None = None) -> None:
        """Send the mark of a control tick to the clients that requested it.

        Args:
            tick: Its number; a client that enters raw mode later receives the newest.
            state: Frames that such a client receives before it, as it has missed them; None
                where newer ones follow soon.
        """
        self._tick = tick
        self._state = b"" if state is None else frame_text(state)
        for client in [c for c in self._clients.values() if c.raw and c.marks]:
            if not tick:
                self._give(client, self._state)
            self._give(client, b"< tick %d >" % tick)

    def close(self) -> None:
        """Give what can be given at once, and end all connections; safe to call twice."""
        for client in list(self._clients.values()):
            client.held_until = 0.0
            self._write(client)
            if client.number in self._clients:
                self._forget(client)
        self._selector.close()
        self._listener.close()

    # -- inside ----------------------------------------------------------------------------

    def _accept(self) -> None:
        try:
            sock, peer = self._listener.accept()
        except OSError as error:
            self._say("warn", f"a client could not be let in: {error.strerror}")
            return
        idle = [client for client in self._clients.values() if not client.raw]
        if len(self._clients) >= MOST_CLIENTS and idle:
            longest = min(idle, key=lambda client: (client.bus_open, client.received_s))
            self._drop(longest, "was silent; its place goes to another one")
        if len(self._clients) >= MOST_CLIENTS:
            self._say("warn", f"no more than {MOST_CLIENTS} clients are let in")
            sock.close()
            return
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._number += 1
        client = BusClient(self._number, sock, peer[1])
        self._clients[client.number] = client
        self._selector.register(sock, client.watched, client)
        self._give(client, b"< hi >")

    def _read(self, client: BusClient) -> None:
        try:
            chunk = client.sock.recv(_CHUNK)
            messages = client.text.feed(chunk)
        except BlockingIOError:
            return
        except OSError:
            chunk, messages = b"", []
        except ValueError as error:
            self._drop(client, f"makes no sense: {error}")
            return
        if messages:
            client.received_s = time.monotonic()
        for message in messages:
            if client.number not in self._clients:
                return
            self._receive(client, message)
        if not chunk:
            self._lose(client)
        elif len(self._sent) >= MOST_SENT:
            for other in self._clients.values():
                self._watch(other)

    def _receive(self, client: BusClient, message: str) -> None:
        """Act on one message."""
        word, _, rest = message.partition(" ")
        if word in _SEND and client.bus_open:
            record = sent_frame(word, rest.strip())
            if record is None:
                self._give(client, b"< error syntax error >")
            else:
                self._sent.append(Sent(client.number, record))
        elif word in ("echo", "undulog"):
            client.marks |= word == "undulog"
            answer = "echo" if word == "echo" else f"undulog {self.identity}"
            self._give(client, f"< {answer} >".encode())
        elif not client.bus_open:
            if word == "open" and rest.strip() == self._bus:
                client.bus_open = True
                self._say("info", f"{client.peer} opened {self._bus}")
                self._give(client, b"< ok >")
            else:
                self._give(client, b"< error could not open bus >")
                self._drop(client, f"asked for {message!r}; there is only {self._bus}")
        elif word in ("rawmode", "bcmmode"):
            self._give(client, b"< ok >")
            client.raw = word == "rawmode"
            client.held_until = time.monotonic() + HOLD_S
            if client.raw and client.marks and self._tick is not None:
                self._give(client, self._state + b"< tick %d >" % self._tick)
        elif word in _UNSUPPORTED:
            self._give(client, b"< error only the raw mode is served >")
        else:
            self._give(client, b"< error unknown command >")

    def _give(self, client: BusClient, text: bytes) -> None:
        if client.number not in self._clients:
            return  # gone meanwhile
        client.out += text
        if len(client.out) > MOST_BYTES:
            self._drop(client, "does not take its frames and was let go")
        else:
            self._write(client)

    def _write(self, client: BusClient) -> None:
        """Send what the connection takes."""
        if client.out and time.monotonic() >= client.held_until:
            try:
                del client.out[: client.sock.send(client.out)]
            except BlockingIOError:
                pass
            except OSError:  # it is gone; what it said before is still to be read, to its end
                client.out.clear()
        self._watch(client)

    def _watch(self, client: BusClient) -> None:
        """Wait for what can go on: reading unless too much was read, writing what is left."""
        events = 0
        if len(self._sent) < MOST_SENT:
            events |= selectors.EVENT_READ
        if client.out and time.monotonic() >= client.held_until:
            events |= selectors.EVENT_WRITE
        if events == client.watched:
            return
        if not events:
            self._selector.unregister(client.sock)
        elif not client.watched:
            self._selector.register(client.sock, events, client)
        else:
            self._selector.modify(client.sock, events, client)
        client.watched = events

    def _drop(self, client: BusClient, why: str) -> None:
        if client.number in self._clients:
            self.dropped += 1
            self._say("warn", f"{client.peer} {why}")
            self._forget(client)

    def _lose(self, client: BusClient) -> None:
        if client.number in self._clients:
            self._say("info", f"{client.peer} is gone")
            self._forget(client)

    def _forget(self, client: BusClient) -> None:
        del self._clients[client.number]
        if client.watched:
            self._selector.unregister(client.sock)
        client.sock.close()


class VirtualBus:
    """The bus over loopback: clients of a socketcand server, and a recorder's socket.

    Attributes:
        sent: Frames that the robot sent.
    """

    def __init__(
        self,
        server: SocketcandServer | None,
        sender: FrameSender | None,
        log_event: Callable[[str, str], None],
    ) -> None:
        """Put the bus together.

        Args:
            server: Where clients listen and send, or None.
            sender: The way to a recorder, or None; it does not have to be there yet.
            say: Told what happens: level, text.

        Raises:
            UsageError: If the recorder's socket can never be used.
        """
        self.sent = self.received = 0
        self._server, self._sender, self._say = server, sender, log_event
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
        """Set the answer to clients that request the identity.

        Args:
            identity: E.g. ``virtual-robot snake25 paced``.
        """
        if self._server is not None:
            self._server.identity = identity

    def mark(self, tick: int, state: FrameArray | None = None) -> None:
        """Send the mark of a control tick to the clients that requested it.

        Args:
            state: The newest frames of the robot's state, for later clients; None where newer ones
                follow soon.
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
            The frames; nobody else has received them yet, see :meth:`relay`.
        """
        if self._server is None:
            return []
        return list(itertools.islice(iter(self._server.take, None), most))

    def relay(self, sent: Sequence[Sent], t_ns: int) -> FrameArray:
        """Send frames of clients to everyone but their senders.

        Args:
            t_ns: The robot's clock [ns]: their time on the bus.

        Returns:
            The frames, marked as sent by the robot's computer.
        """
        frames = records(frame.record for frame in sent)
        frames["t_device_ns"] = t_ns
        self.received += len(frames)
        start = 0
        for client, group in itertools.groupby(frame.client for frame in sent):
            stop = start + len(list(group))
            self._give(frames[start:stop], client)
            start = stop
        return frames

    def send(self, frames: FrameArray) -> None:
        """Send frames of the robot to everyone.

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
        """Send frames to the recorder, and log its connection and disconnection."""
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
