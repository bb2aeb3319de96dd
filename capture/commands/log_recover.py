"""The verb ``log recover``: a whole file from what a crash left."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import emit_json, say
from ..common.interruption import interruptible

if TYPE_CHECKING:
    from ..log.edit.recover import RecoverReport


def log_recover(
    file: Path,
    /,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a whole file from a log whose recorder died, or that was damaged.

    What the MCAP file has in whole chunks and what only the write-ahead log beside it
    (`run.mcap.wal`) has come together, each message once; of a split session all parts. A log
    without a write-ahead log gives what can still be read of it. The record `undulog.recovered`
    says what was found and what is missing. The originals stay as they are: delete them when the
    new file has been looked at. Reading needs no recovery: `log info`, `log check`, `analyse` and
    all others read an unfinished session as it is.

    Example: `undulog log recover run.mcap`

    Args:
        file: The log, any of its parts or their folder; the MCAP file itself may be missing.
        output: The log to write, `.mcap`; `run.recovered.mcap` beside `run.mcap` by default.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..log.edit.recover import recover_log, recovered_path

    with interruptible() as request:
        report = recover_log(file, output or recovered_path(file), force=force, stop=request)
    if json:
        emit_json(report.as_json())
        return
    _tell(report)


def _tell(report: RecoverReport) -> None:
    messages = sum(report.messages.values())
    missing = {None: "how many are missing can't be told", 0: "none is missing"}
    lost = missing.get(report.missing, f"{report.missing} are missing")
    say(
        f"{report.output}: {messages} messages over {report.duration_s:.2f} s, "
        f"{report.from_wal} of them from the write-ahead log; {lost}"
    )
    for warning in report.warnings:
        say(f"warning: {warning}")
    for note in report.notes:
        say(f"note: {note}")
