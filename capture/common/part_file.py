"""A new file that appears under its name only when it is whole."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path

from .console import refuse_existing
from .errors import LogWriteError, UndulogError, UsageError
from .interruption import StopRequest


def check_output(output: Path, endings: Iterable[str], why: str, *, force: bool) -> None:
    """Check an output path before any work is done.

    Args:
        output: The path.
        endings: Any of which its name must have.
        why: What to say if it has none of them.
        force: Whether an existing file may be replaced.

    Raises:
        UsageError: If the name ends otherwise or its folder does not exist.
        OutputExistsError: If it exists and ``force`` is not given.
    """
    if output.suffix.lower() not in tuple(endings):
        raise UsageError(f"{output}: {why}")
    refuse_existing(output, force=force)


@contextmanager
def part_file(output: Path) -> Generator[Path]:
    """Write ``OUTPUT.part``, and rename it on leaving without an exception.

    Args:
        output: The file wanted; one of that name is replaced, so callers that must not replace it
            ask :func:`.capture.common.console.refuse_existing` before they start.

    Yields:
        Where to write.

    Raises:
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    part = output.with_name(f"{output.name}.part")
    try:
        yield part
        part.replace(output)
    except OSError as error:
        if isinstance(error, UndulogError):
            raise
        raise LogWriteError(output, f"can't be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):  # what stopped the writing may stop this too
            part.unlink(missing_ok=True)


def write_text(output: Path, text: str) -> None:
    """Write a text file, which appears only when it is whole.

    Args:
        output: The file wanted; one of that name is replaced, as by :func:`part_file`.
        text: Its content, for UTF-8.

    Raises:
        LogWriteError: If it can't be written; nothing is left behind then.
    """
    with part_file(output) as part:
        part.write_text(text, encoding="utf-8")


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
