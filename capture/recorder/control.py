"""The control socket: requests are answered while the recording runs, without delaying it.

A Unix stream socket of mode 0600, so that only the recorder's own user (and root) can connect.
Each line is a JSON object, ``{"do": "mark", "text": "slipped"}``; each gets one line back,
``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``, in the order of the requests. A client
may stay connected and send any number of requests. The recorder calls :meth:`ControlServer.poll`
once a tick: it handles the received requests, within a time budget, and never waits.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter_ns
from typing import Any, cast

from ..common.errors import ControlError, UndulogError
from .control_client import listen, release

Reply = Mapping[str, Any]

Handler = Callable[[Mapping[str, Any]], Reply | None]
"""Handles a request: returns the reply, or None if :meth:`ControlServer.close` sends it. Raises an
UndulogError to refuse."""

BUFFER = 64 * 1024
"""Longest request, and the most bytes of replies that wait for a slow client [B]."""

TOO_LONG = f"a request is longer than {BUFFER} bytes"

MAX_CLIENTS = 16
"""A further client replaces the one that was silent for longest."""

BUDGET_NS = 1_000_000
"""After this time in one poll the remaining requests wait for the next one [ns]."""

TEND_POLLS = 200
"""Polls between two checks that the socket's file exists."""

_READ = 16 * 1024
_MOST_FAULTS = 8


def _read_request(line: bytes) -> dict[str, Any]:
    if len(line) > BUFFER:
        raise ControlError(TOO_LONG)
    try:
        request = json.loads(line, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ControlError(f"not JSON: {error}") from error
    if not isinstance(request, dict):
        raise ControlError('a request is a JSON object such as {"do": "status"}')
    return cast("dict[str, Any]", request)


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def _reply_line(reply: Reply) -> bytes:
    return json.dumps(reply, allow_nan=False).encode() + b"\n"


def _refusal(error: str) -> bytes:
    return _reply_line({"ok": False, "error": error})


@dataclass(eq=False)
class _Client:
    """One client.

    Attributes:
        last_poll: The poll in which it last sent something.
        incoming: Received bytes that are not answered yet.
        outgoing: Bytes of replies that are not sent yet.
        ended: The client has closed its sending side.
        closing: Nothing more is received from it.
        waits: Its last request is answered at the end of the recording.
        more: A whole request is left from the last poll.
    """

    socket: socket.socket
    last_poll: int
    incoming: bytearray = field(default_factory=bytearray)
    outgoing: bytearray = field(default_factory=bytearray)
    ended: bool = False
    closing: bool = False
    waits: bool = False
    more: bool = False

    @property
    def has_room(self) -> bool:
        return len(self.outgoing) < BUFFER

    @property
    def has_request(self) -> bool:
        # The last one of a client that has ended may lack its newline.
        return b"\n" in self.incoming or (self.ended and bool(self.incoming))

    def lines(self) -> Iterator[bytes]:
        """Remove the whole requests from the buffer, one at a time."""
        while self.has_request:
            end = self.incoming.find(b"\n") + 1 or len(self.incoming)
            line = bytes(self.incoming[:end])
            del self.incoming[:end]
            yield line


class ControlServer:
    """Serves the control socket from the recorder's loop.

    Attributes:
        requests: Number of requests answered so far.
    """

    def __init__(self, path: Path, handler: Handler | None = None) -> None:
        """Listen.

        Args:
            path: The socket; its folder must exist.
            handler: None to set it later with :meth:`serve`.

        Raises:
            SocketInUseError: If another recorder listens there.
            ControlError: If another file is there, or the socket can't be made.
        """
        self.path = path
        self.requests = 0
        self._faults: list[str] = []
        self._handler = handler or _not_yet
        self._listener, self._identity = listen(path, backlog=MAX_CLIENTS)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._clients: dict[socket.socket, _Client] = {}
        self._polls = 0
        self._open = True

    def serve(self, handler: Handler) -> None:
        """Set the handler.

        The socket can be claimed before any file is created: a recorder that is refused its socket
        leaves no file behind.

        Args:
            handler: The text of an error that it raises is the reply's ``error``; an error other
                than :class:`UndulogError` is also reported by :meth:`take_faults`.
        """
        self._handler = handler

    def take_faults(self) -> tuple[str, ...]:
        """Return the internal errors since the last call, one sentence each."""
        faults, self._faults = tuple(self._faults), []
        return faults

    def poll(self) -> None:
        """Receive and answer requests, without waiting."""
        self._polls += 1
        if self._polls % TEND_POLLS == 0:
            self._restore_file()
        ready = self._selector.select(0)
        busy = [client for client in self._clients.values() if client.more and client.has_room]
        if not ready and not busy:
            return
        end_ns = perf_counter_ns() + BUDGET_NS
        for key, events in ready:
            if key.fileobj is self._listener:
                self._accept()
                continue
            client = self._clients.get(cast("socket.socket", key.fileobj))
            if client is not None:
                if events & selectors.EVENT_READ:
                    self._receive(client)
                busy.append(client)
        # The order rotates, so that no client uses the budget alone.
        busy = list(dict.fromkeys(busy))
        first = self._polls % len(busy) if busy else 0
        for client in busy[first:] + busy[:first]:
            if client.socket in self._clients:
                self._answer(client, end_ns)
                self._send(client)

    def close(self, farewell: Reply | None = None) -> None:
        """Stop listening and disconnect all clients; safe to call twice.

        Args:
            farewell: The reply to the requests whose handler returned None.
        """
        if not self._open:
            return
        self._open = False
        release(self.path, self._listener, self._identity)
        for client in list(self._clients.values()):
            if client.waits and farewell is not None:
                client.outgoing += _reply_line({"ok": True, **farewell})
            self._send(client)
            self._drop(client)
        self._selector.close()

    # -- one client ------------------------------------------------------------------------

    def _restore_file(self) -> None:
        """Make the socket again if its file is gone.

        A user's runtime folder is removed with the last log-out while the recorder continues; the
        next session must find the socket.
        """
        if os.path.lexists(self.path):
            return
        try:
            self.path.parent.mkdir(mode=0o700, exist_ok=True)
            listener, identity = listen(self.path, backlog=MAX_CLIENTS, patience_s=0.0)
        except (ControlError, OSError):  # its folder isn't back yet; tried again later
            return
        self._selector.unregister(self._listener)
        self._listener.close()
        self._listener, self._identity = listener, identity
        self._selector.register(listener, selectors.EVENT_READ)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                # No further caller, one that gave up already, or no free descriptor: the recording
                # continues without its control socket, and the caller gets no answer.
                return
            if len(self._clients) >= MAX_CLIENTS:
                silent = min(self._clients.values(), key=lambda client: client.last_poll)
                silent.outgoing += _refusal(f"{MAX_CLIENTS} others are connected")
                self._send(silent)
                self._drop(silent)
            connection.setblocking(False)
            self._clients[connection] = _Client(connection, self._polls)
            self._selector.register(connection, selectors.EVENT_READ)

    def _receive(self, client: _Client) -> None:
        try:
            data = client.socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:  # reset by the client
            self._drop(client)
            return
        if not data:
            client.ended = True  # it may still wait for its replies
            return
        client.last_poll = self._polls
        client.incoming += data

    def _answer(self, client: _Client, end_ns: int) -> None:
        """Answer the whole requests, as far as budget and buffer allow."""
        client.more = False
        if client.waits:
            return
        for line in client.lines():
            if line.strip():
                reply = self._reply(line)
                client.waits = reply is None
                client.outgoing += reply or b""
            if client.waits or not client.has_room or perf_counter_ns() > end_ns:
                client.more = not client.waits and client.has_request
                return
        if len(client.incoming) > BUFFER:
            client.outgoing += _refusal(TOO_LONG)
            client.incoming.clear()
            client.closing = True

    def _reply(self, line: bytes) -> bytes | None:
        self.requests += 1
        try:
            reply = self._handler(_read_request(line))
            if reply is None:
                return None
            data = _reply_line({"ok": True, **reply})
        except UndulogError as error:
            return _refusal(str(error))
        except Exception as error:  # noqa: BLE001 - no request ends the recording
            if len(self._faults) < _MOST_FAULTS:
                self._faults.append(f"a request failed with {error!r}: {line[:80]!r}")
            return _refusal(f"a mistake of the recorder's own: {error!r}")
        return data if len(data) <= BUFFER else _refusal(f"the reply has {len(data)} bytes")

    def _send(self, client: _Client) -> None:
        """Send without waiting; receive from the client only while it takes its replies."""
        try:
            while client.outgoing:
                sent = client.socket.send(client.outgoing)
                del client.outgoing[:sent]
        except BlockingIOError:
            pass  # the rest is sent when the client has read
        except OSError:  # disconnected
            self._drop(client)
            return
        finished = client.closing or (client.ended and not client.incoming and not client.waits)
        if finished and not client.outgoing:
            self._drop(client)
            return
        listening = client.has_room and not client.ended and not client.closing
        events = selectors.EVENT_READ if listening and len(client.incoming) <= BUFFER else 0
        events |= selectors.EVENT_WRITE if client.outgoing else 0
        self._watch(client, events)

    def _watch(self, client: _Client, events: int) -> None:
        watched = self._selector.get_map().get(client.socket)
        if watched is not None and watched.events == events:
            return
        if watched is not None:
            self._selector.unregister(client.socket)
        if events:
            self._selector.register(client.socket, events)

    def _drop(self, client: _Client) -> None:
        if self._clients.pop(client.socket, None) is None:
            return
        with suppress(KeyError):  # not registered: full, or ended
            self._selector.unregister(client.socket)
        client.socket.close()


def _not_yet(request: Mapping[str, Any]) -> Reply:
    del request
    raise ControlError("the recording has not begun yet")
