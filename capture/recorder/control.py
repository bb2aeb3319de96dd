"""The control socket: requests come in while the recording runs, and never hold it up.

A Unix stream socket of mode 0600, so that only the recorder's own user (and root) can speak to it.
Each line is a JSON object, ``{"do": "mark", "text": "slipped"}``; each gets one line back,
``{"ok": true, ...}`` or ``{"ok": false, "error": "..."}``, in the order of the requests. A client
may stay connected and send as many as it likes. The recorder calls :meth:`ControlServer.poll` once
a tick: it takes what has come, within a budget, and waits for nobody.
"""

from __future__ import annotations

import json
import os
import selectors
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from time import perf_counter_ns
from typing import Any, Final, cast

from ..common.errors import ControlError, UndulogError
from .control_client import listen, release

Reply = Mapping[str, Any]

BUFFER = 64 * 1024
"""Longest request, and the most replies that wait for a client that doesn't read [B]."""

TOO_LONG = f"a request is longer than {BUFFER} bytes"


def read_request(line: bytes) -> dict[str, Any] | str:
    """Read one line.

    Args:
        line: With or without its newline.

    Returns:
        The request, or what is wrong with the line.
    """
    if len(line) > BUFFER:
        return TOO_LONG
    try:
        request = json.loads(line, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        return f"not JSON: {error}"
    if not isinstance(request, dict):
        return 'a request is a JSON object such as {"do": "status"}'
    return cast("dict[str, Any]", request)


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number")


def reply_line(reply: Reply) -> bytes:
    """Write one line.

    Returns:
        The line, its newline at the end.

    Raises:
        ValueError: If it has a number that JSON doesn't have.
        TypeError: If it has a value that JSON doesn't have.
    """
    return json.dumps(reply, allow_nan=False).encode() + b"\n"


def refusal(error: str) -> bytes:
    """The reply to what can't be done."""
    return reply_line({"ok": False, "error": error})


class Connection:
    """One client.

    Attributes:
        heard: The poll in which it last said something.
        incoming: Bytes of requests that are not answered yet.
        outgoing: Bytes of replies that it has not taken yet.
        ended: It will send no more.
        closing: We take no more from it.
        waits: For the end of the recording.
        more: A whole request is left from the last poll.
    """

    def __init__(self, connection: socket.socket, number: int) -> None:
        """Nothing has come yet.

        Args:
            number: The poll in which it connected.
        """
        self.socket = connection
        self.heard = number
        self.incoming = bytearray()
        self.outgoing = bytearray()
        self.ended = False
        self.closing = False
        self.waits = False
        self.more = False

    @property
    def has_room(self) -> bool:
        """Whether a reply still fits."""
        return len(self.outgoing) < BUFFER

    @property
    def has_request(self) -> bool:
        """Whether a whole request has come."""
        # The last one of a client that has ended may lack its newline.
        return b"\n" in self.incoming or (self.ended and bool(self.incoming))

    def lines(self) -> Iterator[bytes]:
        """The requests that have come whole.

        Yields:
            Each, taken off the buffer as it is handed out.
        """
        while self.has_request:
            at = self.incoming.find(b"\n")
            end = len(self.incoming) if at < 0 else at + 1
            line = bytes(self.incoming[:end])
            del self.incoming[:end]
            yield line


MAX_CLIENTS = 16
"""More than these and the one that was silent for longest is let go."""

BUDGET_NS = 1_000_000
"""After so long in one poll the remaining requests wait for the next one [ns]."""

TEND_POLLS = 200
"""Every so many polls the server looks whether its socket is still there."""

_READ = 16 * 1024
_MOST_FAULTS = 8


class _Later:
    """The type of :data:`LATER`."""


LATER: Final = _Later()
"""A handler's answer to a request whose reply comes with :meth:`ControlServer.close`."""

Handler = Callable[[Mapping[str, Any]], "Reply | _Later"]
"""Does what a request asks; raises an UndulogError to refuse."""


class ControlServer:
    """Serves the control socket from the recorder's loop."""

    def __init__(self, path: Path, handler: Handler | None = None) -> None:
        """Listen.

        Args:
            path: Where; its folder must be there.
            handler: Does what is asked; None where :meth:`serve` says so later.

        Raises:
            SocketInUseError: If another recorder listens there.
            ControlError: If something else is in the way, or the socket can't be made.
        """
        self.path = path
        self.requests = 0
        """Requests answered so far."""
        self._faults: list[str] = []
        self._handler = handler or _not_yet
        self._listener, self._identity = listen(path, backlog=MAX_CLIENTS)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._clients: dict[socket.socket, Connection] = {}
        self._polls = 0
        self._open = True

    @property
    def clients(self) -> int:
        """Number of connections."""
        return len(self._clients)

    def serve(self, handler: Handler) -> None:
        """Have requests carried out from now on.

        The socket can be claimed before anything is created, and served when all is there: a
        recorder that is refused its socket leaves no file behind.

        Args:
            handler: Does what is asked. What it raises is the reply's ``error``; what is no
                :class:`UndulogError` is a mistake of ours and told by :meth:`take_faults` too.
        """
        self._handler = handler

    def take_faults(self) -> tuple[str, ...]:
        """Mistakes of ours that requests brought to light since the last call.

        Returns:
            One sentence each.
        """
        faults, self._faults = tuple(self._faults), []
        return faults

    def poll(self) -> None:
        """Take and answer what has come; returns at once."""
        self._polls += 1
        if self._polls % TEND_POLLS == 0:
            self._tend()
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
        # The one that is first served changes, so that none can keep the budget for itself.
        busy = list(dict.fromkeys(busy))
        first = self._polls % len(busy) if busy else 0
        for client in busy[first:] + busy[:first]:
            if client.socket in self._clients:
                self._answer(client, end_ns)
                self._send(client)

    def close(self, farewell: Reply | None = None) -> None:
        """Stop listening and let everybody go; safe to call twice.

        Args:
            farewell: The reply to those whose request was answered with :data:`LATER`.
        """
        if not self._open:
            return
        self._open = False
        release(self.path, self._listener, self._identity)
        for client in list(self._clients.values()):
            if client.waits and farewell is not None:
                client.outgoing += reply_line({"ok": True, **farewell})
            self._send(client)
            self._drop(client)
        self._selector.close()

    # -- one client ------------------------------------------------------------------------

    def _tend(self) -> None:
        """Make the socket again where it has gone.

        A user's runtime folder goes with the last log-out, and the recorder stays: who comes back
        must find it.
        """
        if os.path.lexists(self.path):
            return
        try:
            self.path.parent.mkdir(mode=0o700, exist_ok=True)
            listener, identity = listen(self.path, backlog=MAX_CLIENTS, patience_s=0.0)
        except (ControlError, OSError):  # its folder isn't back yet; we look again
            return
        self._selector.unregister(self._listener)
        self._listener.close()
        self._listener, self._identity = listener, identity
        self._selector.register(listener, selectors.EVENT_READ)

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError:
                # The caller gave up already, or we are out of descriptors: a recorder without
                # its control socket goes on, and the caller sees that nobody answers.
                return
            if len(self._clients) >= MAX_CLIENTS:
                silent = min(self._clients.values(), key=lambda client: client.heard)
                silent.outgoing += refusal(f"{MAX_CLIENTS} others are connected")
                self._send(silent)
                self._drop(silent)
            connection.setblocking(False)
            self._clients[connection] = Connection(connection, self._polls)
            self._selector.register(connection, selectors.EVENT_READ)

    def _receive(self, client: Connection) -> None:
        try:
            data = client.socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:  # reset by the client: nobody is left to tell
            self._drop(client)
            return
        if not data:
            client.ended = True  # or it only stops sending, and waits for its replies
            return
        client.heard = self._polls
        client.incoming += data

    def _answer(self, client: Connection, end_ns: int) -> None:
        """Answer the whole requests that have come, as far as budget and buffer go."""
        client.more = False
        if client.waits:
            return
        for line in client.lines():
            if line.strip():
                reply = self._reply(line)
                if isinstance(reply, bytes):
                    client.outgoing += reply
                else:
                    client.waits = True
            if client.waits or not client.has_room or perf_counter_ns() > end_ns:
                client.more = not client.waits and client.has_request
                return
        if len(client.incoming) > BUFFER:
            client.outgoing += refusal(TOO_LONG)
            client.incoming.clear()
            client.closing = True

    def _reply(self, line: bytes) -> bytes | _Later:
        self.requests += 1
        request = read_request(line)
        if isinstance(request, str):
            return refusal(request)
        try:
            reply = self._handler(request)
            if isinstance(reply, _Later):
                return reply
            data = reply_line({"ok": True, **reply})
        except UndulogError as error:
            return refusal(str(error))
        except Exception as error:  # noqa: BLE001 - the recording goes on, whatever was asked
            if len(self._faults) < _MOST_FAULTS:
                self._faults.append(f"a request failed with {error!r}: {line[:80]!r}")
            return refusal(f"a mistake of the recorder's own: {error!r}")
        return data if len(data) <= BUFFER else refusal(f"the reply has {len(data)} bytes")

    def _send(self, client: Connection) -> None:
        """Send what the socket takes; listen to the client only while its replies get through."""
        try:
            while client.outgoing:
                sent = client.socket.send(client.outgoing)
                del client.outgoing[:sent]
        except BlockingIOError:
            pass  # the rest goes when the client reads
        except OSError:  # it has gone
            self._drop(client)
            return
        finished = client.closing or (client.ended and not client.incoming and not client.waits)
        if finished and not client.outgoing:
            self._drop(client)
            return
        listening = client.has_room and not client.ended and not client.closing
        wanted = selectors.EVENT_READ if listening and len(client.incoming) <= BUFFER else 0
        wanted |= selectors.EVENT_WRITE if client.outgoing else 0
        self._watch(client, wanted)

    def _watch(self, client: Connection, events: int) -> None:
        watched = self._selector.get_map().get(client.socket)
        if watched is not None and watched.events == events:
            return
        if watched is not None and events:
            self._selector.modify(client.socket, events)
        elif watched is not None:
            self._selector.unregister(client.socket)
        elif events:
            self._selector.register(client.socket, events)

    def _drop(self, client: Connection) -> None:
        if self._clients.pop(client.socket, None) is None:
            return
        with suppress(KeyError):  # it may be unwatched: full, or ended
            self._selector.unregister(client.socket)
        client.socket.close()


def _not_yet(request: Mapping[str, Any]) -> Reply:
    del request
    raise ControlError("the recording has not begun yet")
