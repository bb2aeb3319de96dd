"""Imported sessions: written whole, the same bytes from the same log."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from zstandard import STRATEGY_FAST, ZstdCompressionParameters

from ..common.console import refuse_existing
from ..common.files import part_file
from ..common.process import helpers, threads_or_default
from ..log.file.log_file import keep_freed
from ..log.mcap.writer import Compression
from ..log.write.mcap_sink import McapSink
from ..log.write.writer import SessionWriter
from ..robot.model import Robot

LEVEL: Compression = 2
"""Of compression: a third less time than level 3 for a few per cent more bytes."""

FLOAT32: Compression = ZstdCompressionParameters(
    window_log=20,
    hash_log=12,
    chain_log=12,
    search_log=1,
    min_match=5,
    target_length=1,
    strategy=STRATEGY_FAST,
    write_checksum=True,
)
"""Of messages whose numbers had single precision: those of neighbours share few bytes, so that a
table of matches in the nearest cache finds as many. A quarter to a third less time than level 2,
for 2 % fewer to 5 % more bytes; rounded decimals take up to twice as many."""

_REUSED = 1 << 24
"""Bytes of freed memory that are used again: blocks of rows and chunks are allocated anew, and
getting a new page from the system takes longer than filling it."""


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def digest_of(files: Sequence[Path]) -> str:
    """Return the SHA-256 of one file, or of the names and digests of several."""
    if len(files) == 1:
        return file_digest(files[0])
    parts = "".join(f"{path.name} {file_digest(path)}\n" for path in files)
    return hashlib.sha256(parts.encode()).hexdigest()


@contextmanager
def imported_session(
    source: Path,
    output: Path,
    robot: Robot | None,
    *,
    epoch_ns: int,
    facts: Mapping[str, str],
    force: bool,
    digest: Callable[[], str] | None = None,
    compression: Compression = LEVEL,
) -> Generator[SessionWriter]:
    """Write an imported session, which appears under its name only when it is whole.

    The same log gives the same session id and, with the same robot, the same bytes: no clock and
    no path of this machine enters the file.

    Args:
        robot: The robot that made the log, if it is known.
        epoch_ns: Time of its first sample [Unix ns].
        facts: For the session's metadata.
        digest: Returns that of the log, where that is more than the file ``source``.
        compression: Of the messages.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    refuse_existing(output, force=force)
    keep_freed(_REUSED)
    of_log = file_digest(source) if digest is None else digest()
    with (
        part_file(output) as part,
        helpers(threads_or_default(None)) as pool,
        SessionWriter(
            part,
            session_id=f"import-{of_log[:16]}",
            epoch_ns=epoch_ns,
            robot=robot,
            clock={"log": str(robot.clock)} if robot else {},
            metadata={"source": source.name, "source.sha256": of_log, **facts},
            sink=McapSink(part, force=True, compression=compression, helpers=pool),
        ) as writer,
    ):
        yield writer
