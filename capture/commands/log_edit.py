"""Commands ``log cut`` and ``log merge``: an edit always writes a new file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import emit
from ..common.process import interruptible
from ..log.file.content import session_label

if TYPE_CHECKING:
    from ..log.cut import RecoverReport
    from ..log.edited_log import EditReport


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
    lists what was found and what is missing. The originals stay as they are: delete them when the
    new file has been looked at. Reading needs no recovery: `log info`, `log check`, `analyse` and
    all others read an unfinished session as it is.

    Example: `undulog log recover run.mcap`

    Args:
        file: The log, any of its parts or their folder; the MCAP file itself may be missing.
        output: The log to write, `.mcap`; `run.recovered.mcap` beside `run.mcap` by default.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..log.cut import recover_log, recovered_path

    with interruptible() as request:
        report = recover_log(file, output or recovered_path(file), force=force, stop=request)
    messages = sum(report.messages.values())
    missing = {None: "how many are missing is unknown", 0: "none is missing"}
    lost = missing.get(report.missing, f"{report.missing} are missing")
    first = (
        f"{report.output}: {messages} messages over {report.duration_s:.2f} s, "
        f"{report.from_wal} of them from the write-ahead log; {lost}"
    )
    emit(report.as_json(), [first, *_remarks(report)], as_json=json)


def _remarks(report: EditReport | RecoverReport) -> list[str]:
    return [
        *(f"warning: {warning}" for warning in report.warnings),
        *(f"note: {note}" for note in report.notes),
    ]


def log_cut(
    file: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    start: float = 0.0,
    stop: float | None = None,
    topics: Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)] = (),
    carry_state: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a part of a log, of any make, to a new file.

    The window is half-open in log time: a message at --start is in, one at --stop is not, so that
    cuts laid side by side hold every message once. Message bytes, sequence numbers and times stay
    as they are, and so do attachments and metadata; the record `undulog.edit` describes
    the cut. Topics published only on a change (`/gait/mode`, `/robot_description`,
    `/tf_static`, whatever was recorded as transient local) may have their last message before
    the window: that is reported, and --carry-state copies it, with the log time of --start.

    Example: `undulog log cut run.mcap --start 8 --stop 16 -o steady.mcap`

    Only the joints: `undulog log cut run.mcap --topics '/joint_*' /gait -o joints.mcap`

    Args:
        file: An MCAP file, of any make; of a damaged one, what can be read.
        output: The log to write, `.mcap`.
        start: First log time wanted [s], from the log's first message.
        stop: End of the window [s], from the log's first message; the log's end by default.
        topics: Topics to keep, `*` and `?` as in a shell; all by default.
        carry_state: Copy the last earlier message of each such topic to the start.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..log.cut import cut_log

    with interruptible() as request:
        report = cut_log(
            file,
            output,
            start_s=start,
            stop_s=stop,
            topics=topics,
            carry_state=carry_state,
            force=force,
            stop=request,
        )
    emit(report.as_json(), _lines(report), as_json=json)


def log_merge(
    *files: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    robot: str | None = None,
    apart: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Put several logs into one new file, interleaved by log time.

    Of equal log times the log that is named first comes first. A topic that several logs have
    becomes one; if its types or units differ, nothing is merged. Message bytes, sequence numbers
    and times stay as they are. Of attachments and metadata the same is kept once and the different
    under a name of its own; the record `undulog.edit` lists the session ids and hashes of all logs.
    Logs of different robots are refused unless --robot names the one that the session is of, and
    logs with more than a day between them unless --apart is given; both are warned of then, and so
    are logs that have no joint in common or more than a minute between them.

    Example: `undulog log merge robot.mcap tracking.mcap -o both.mcap`

    Args:
        files: MCAP files, of any make; of a damaged one, what can be read.
        output: The log to write, `.mcap`.
        robot: Where the logs are of different robots, the one that the merged session is of.
        apart: Merge logs with more than a day between them, too.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..log.merge import merge_logs

    with interruptible() as request:
        report = merge_logs(files, output, robot=robot, apart=apart, force=force, stop=request)
    emit(report.as_json(), _lines(report), as_json=json)


def _lines(report: EditReport) -> Iterator[str]:
    messages = sum(report.messages.values())
    names = (session_label(source["session_id"], source["path"]) for source in report.sources)
    origin = ", ".join(dict.fromkeys(names))
    size = f"{report.output.stat().st_size / 1e6:.1f} MB"
    yield f"{report.output}: {report.duration_s:.2f} s of {origin}, {messages} messages, {size}"
    yield from _remarks(report)
    width = max(map(len, report.messages), default=0)
    yield from (f"  {topic:<{width}}  {count} messages" for topic, count in report.messages.items())
