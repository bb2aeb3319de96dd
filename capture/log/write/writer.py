"""The session writer: samples in, a log to the contract out.

Where the records go is a sink's business; without one they go straight to an MCAP file, which is
finalised when the ``with`` block is left, however it is left.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import Self

from mcap.records import Attachment, Channel, Metadata, Schema

from ...common.errors import DataError, LogWriteError
from ...robot.mesh import mesh_type
from ...robot.model import Robot
from ..messages.schemas import schema_text
from ..sinks.mcap_sink import McapSink
from ..sinks.sink import MessageSink
from .channels import Send
from .openers import ChannelOpeners

CONTRACT_VERSION = "1"
"""Version of the log contract that this writer follows."""


class SessionWriter(ChannelOpeners):
    """Writes one session."""

    def __init__(
        self,
        path: Path | str,
        *,
        session_id: str,
        epoch_ns: int,
        robot: Robot | None = None,
        clock: Mapping[str, str] | None = None,
        metadata: Mapping[str, str] | None = None,
        force: bool = False,
        sink: MessageSink | None = None,
    ) -> None:
        """Open the session and write what explains it.

        Args:
            path: The file to create.
            session_id: Names the session; the same for all its parts.
            epoch_ns: Unix time of the session's start [ns].
            robot: Its description travels as attachments ``robot.toml`` and its DBC files.
            clock: Source name to clock domain.
            metadata: Further facts, e.g. ``operator``; all values are strings.
            force: Replace an existing file.
            sink: Where the records go, and who opens the file then: ``path`` only names the
                session in errors and ``force`` has no meaning. The session closes it.

        Raises:
            OutputExistsError: If the file is there and ``force`` is not given.
            LogWriteError: If it can't be created or written.
        """
        super().__init__()
        self.path = Path(path)
        self._epoch_ns = epoch_ns
        self._open = True
        self._sink = McapSink(self.path, force=force) if sink is None else sink
        self._schemas: dict[str, int] = {}
        self._topics: set[str] = set()
        self._last: dict[str, Metadata] = {}
        facts = {
            "session_id": session_id,
            "contract": CONTRACT_VERSION,
            "epoch_ns": str(epoch_ns),
            "robot": robot.name if robot is not None else "",
            "undulog": version("undulog"),
        }
        facts |= {f"clock.{source}": domain for source, domain in (clock or {}).items()}
        facts |= dict(metadata or {})
        self.note("undulog", facts)
        if robot is not None:
            self.attach("robot.toml", "application/toml", robot.toml.encode())
            for name, text in robot.databases:
                self.attach(name, "text/plain", text.encode())
            for name, data in robot.meshes:
                self.attach(name, mesh_type(name) or "application/octet-stream", data)

    def __enter__(self) -> Self:
        """Nothing to do: the session is open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finalise the session, also when the block is left by an exception."""
        self.close()

    # -- whole session ---------------------------------------------------------------------

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        """Store a file inside the session.

        Args:
            name: File name, e.g. ``scenario.toml``.
            media_type: Its media type, e.g. ``application/toml``.
            data: Its bytes.

        Raises:
            LogWriteError: If the session can't be written.
        """
        self._sink.define(Attachment(self._epoch_ns, self._epoch_ns, name, media_type, data))

    def note(self, name: str, facts: Mapping[str, str]) -> None:
        """Write a metadata record now; a reader puts records of one name together.

        Args:
            name: Its name, e.g. ``undulog``.
            facts: Its entries.

        Raises:
            LogWriteError: If the session can't be written.
        """
        self._sink.define(Metadata(name, dict(facts)))

    def explain(self, texts: Mapping[str, bytes], records: Mapping[str, Mapping[str, str]]) -> None:
        """Store what a session was made from.

        Args:
            texts: File name to TOML text, e.g. ``plan.toml``.
            records: Metadata records by name.

        Raises:
            LogWriteError: If the session can't be written.
        """
        for name, text in texts.items():
            self.attach(name, "application/toml", text)
        for name, facts in records.items():
            self.note(name, facts)

    def note_at_end(self, name: str, facts: Mapping[str, str]) -> None:
        """Keep a metadata record until the session is closed.

        Args:
            name: Its name, e.g. ``undulog.clock``; another one of that name is replaced.
            facts: Its entries.
        """
        self._last[name] = Metadata(name, dict(facts))

    def set_verdict(self, verdict: str, reasons: Sequence[str] = ()) -> None:
        """State the session's health, written when it is closed.

        Args:
            verdict: ``good``, ``degraded`` or ``bad``.
            reasons: Why, one sentence each.
        """
        self.note_at_end(
            "undulog.health", {"verdict": verdict, "reasons": json.dumps(list(reasons))}
        )

    def close(self) -> None:
        """Finalise; safe to call twice.

        Raises:
            LogWriteError: If the summary can't be written.
        """
        if not self._open:
            return
        self._open = False
        self._sink.close(tuple(self._last.values()))

    # -- inside ----------------------------------------------------------------------------

    def _sender(
        self, topic: str, type_name: str, metadata: Mapping[str, str] | None = None
    ) -> Send:
        """Register a channel; returns what writes one message of it."""
        if topic in self._topics:
            raise DataError(f"{topic} is open already; a topic has one channel")
        if type_name not in self._schemas:
            schema_id = len(self._schemas) + 1
            text = schema_text(type_name).encode()
            self._sink.define(Schema(schema_id, text, "ros2msg", type_name))
            self._schemas[type_name] = schema_id
        channel_id = len(self._topics) + 1
        schema_id = self._schemas[type_name]
        self._sink.define(Channel(channel_id, topic, "cdr", dict(metadata or {}), schema_id))
        self._topics.add(topic)
        sequence = 0
        write = self._sink.write

        def send(log_time_ns: int, stamp_ns: int, data: bytes) -> None:
            nonlocal sequence
            if not self._open:
                raise LogWriteError(self.path, f"{topic}: the session is closed")
            write(channel_id, log_time_ns, stamp_ns, sequence, data)
            sequence = (sequence + 1) & 0xFFFF_FFFF

        return send
