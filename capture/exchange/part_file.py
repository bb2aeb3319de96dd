"""A new file that appears under its name only when it is whole."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from ..console import refuse_existing
from ..errors import LogWriteError
from ..interruption import StopRequest


@contextmanager
def part_file(output: Path, *, force: bool) -> Generator[Path]:
    """Write ``OUTPUT.part``, and rename it on leaving without an exception.

    Args:
        output: The file wanted.
        force: Replace an existing file.

    Yields:
        Where to write.

    Raises:
        OutputExistsError: If the output is there and ``force`` is not given.
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    refuse_existing(output, force=force)
    part = output.with_name(f"{output.name}.part")
    try:
        yield part
        part.replace(output)
    except OSError as error:
        if isinstance(error, LogWriteError):
            raise
        raise LogWriteError(output, f"can't be written: {error.strerror or error}") from error
    finally:
        part.unlink(missing_ok=True)


def check_stop(output: Path, stop: StopRequest | None) -> None:
    """End the writing of a part file if an end was asked for.

    Args:
        output: The file wanted.
        stop: The request to look at.

    Raises:
        LogWriteError: If an end was asked for.
    """
    if stop is not None and stop.requested:
        raise LogWriteError(output, "stopped on request, nothing is written")
