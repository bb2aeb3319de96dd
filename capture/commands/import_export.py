"""Commands ``import`` and ``log export``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import emit
from ..common.errors import ImportFormatError, UsageError
from ..common.files import check_output, is_file

if TYPE_CHECKING:
    from ..exchange.can_import import ImportReport
    from ..exchange.csv_import import ColumnMap
    from ..robot.model import Robot


def import_log(
    log: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    robot: Annotated[str, Parameter(name=["--robot", "-r"])],
    columns: Path | None = None,
    map_: Annotated[tuple[str, ...], Parameter(name="--map", show_default=False)] = (),
    bus: str | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Turn another tool's log into a session.

    CAN traces (candump .log, .asc, .blf, .trc, python-can .csv and .db, .mf4) keep every frame and
    its direction; the robot's bus map defines which of them are joint commands, states and sensor
    values. Any other CSV needs a column map, as a file or as --map options.

    Example: `undulog import trace.log -o run.mcap --robot arcsnake-joint`

    A CSV: `undulog import joint.csv -o run.mcap --robot arcsnake-joint --map time=time:s
    --map angle=joint01.position:deg,wrap=360`

    Args:
        log: The foreign log.
        output: The session to write, `.mcap`.
        robot: A shipped robot (snake25, snake13, snake13-planar, snake12-sts3215, so101,
            arcsnake-joint) or a robot TOML.
        columns: Column map of a CSV, as TOML.
        map_: One column of a CSV: `COLUMN=time:UNIT`, or `COLUMN=JOINT.QUANTITY:UNIT` with
            `,wrap=PERIOD`, `,scale=FACTOR`, `,offset=VALUE` where needed. May be repeated.
        bus: The bus to decode, where the log has several; the first one by default.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..common.process import interruptible
    from ..exchange.can_import import import_can
    from ..exchange.csv_import import import_csv
    from ..robot.description import load_robot

    why = f"a session is an .mcap file, not {output.suffix or 'nameless'}"
    check_output(output, (".mcap",), why, force=force)
    described = load_robot(robot)
    column_map = _column_map(log, described, columns, map_)
    if column_map is not None and bus is not None:
        raise UsageError(f"{log} holds no CAN frames; --bus is for those")
    with interruptible() as stop:
        if column_map is None:
            report = import_can(log, output, described, bus=bus, force=force, stop=stop)
        else:
            report = import_csv(log, output, described, column_map, force=force, stop=stop)
    emit(report.as_json(), _import_lines(report), as_json=json)
    return 0 if report.complete else 1


def export_log(
    session: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    bus: str | None = None,
    topics: Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)] = (),
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a session for other tools: its raw CAN frames, or its joint columns as a table.

    The suffix of the output selects the format. Frames: .log (candump), .blf and .asc (Vector),
    .mcap (ROS 2, one can_msgs/msg/Frame a frame). Columns: .csv and .parquet, one row a sample of a
    joint at its own time. What a format can't hold is counted in a warning.

    Example: `undulog log export run.mcap -o trace.log`

    For Vector's tools: `undulog log export run.mcap -o trace.blf`, or `-o trace.asc`

    For ROS 2: `undulog log export run.mcap -o frames.mcap`

    For pandas: `undulog log export run.mcap -o run.csv`, or `-o states.parquet --topics
    /joint_states`

    Args:
        session: The session.
        output: The file to write.
        bus: The bus whose frames to write; all by default.
        topics: The JointState topics whose columns to write; commands and whatever the joints
            measure by default.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..common.process import interruptible
    from ..exchange.export import TABLE_FORMATS, export_columns
    from ..exchange.export import export_log as export_frames
    from ..exchange.frame_formats import FRAME_FORMATS

    suffix = output.suffix.lower()
    if suffix not in FRAME_FORMATS and suffix not in TABLE_FORMATS:
        valid = ", ".join([*FRAME_FORMATS, *TABLE_FORMATS])
        raise UsageError(f"{output}: no format has the suffix {suffix!r}; valid: {valid}")
    with interruptible() as stop:
        if suffix in TABLE_FORMATS:
            if bus is not None:
                raise UsageError(f"--bus is for CAN frames; a {suffix} file has joint columns")
            table = export_columns(session, output, topics=topics, force=force, stop=stop)
            counts = {"rows": sum(table.rows.values()), "topics": table.rows}
            what = f"{counts['rows']} rows of {', '.join(table.rows)}"
            warnings = table.warnings
        else:
            if topics:
                raise UsageError(f"--topics is for tables; a {suffix} file has CAN frames")
            trace = export_frames(session, output, bus=bus, force=force, stop=stop)
            counts = {"frames": sum(trace.buses.values()), "buses": trace.buses}
            what = f"{counts['frames']} frames of {', '.join(trace.buses)}, "
            what += f"in the format of {trace.title}"
            warnings = trace.warnings
    facts = {"source": str(session), "output": str(output), **counts, "warnings": warnings}
    lines = [f"{output}: {what}", *(f"  warning: {warning}" for warning in warnings)]
    emit(facts, lines, as_json=json)


def _column_map(
    log: Path, robot: Robot, columns: Path | None, options: tuple[str, ...]
) -> ColumnMap | None:
    """Return the column map of a CSV log; None for a log of CAN frames."""
    from ..exchange.csv_import import column_map_from_options, is_frame_csv, read_column_map

    if not is_file(log):
        raise ImportFormatError(log, "no such file")
    if log.suffix.lower() != ".csv" or is_frame_csv(log):
        if columns is not None or options:
            raise UsageError(f"{log} holds CAN frames; --columns and --map are for other CSV logs")
        return None
    if (columns is None) == (not options):
        given = "not both" if options else "to describe its columns"
        raise UsageError(f"{log} needs --columns MAP.toml or --map options, {given}")
    if columns is not None:
        return read_column_map(columns, robot)
    return column_map_from_options(options, robot)


def _import_lines(report: ImportReport) -> Iterator[str]:
    frames = f"{report.frames} CAN frames, " if report.frames is not None else ""
    length = f"{report.duration_s:.1f} s of {report.robot}"
    yield f"{report.output}: {length}, {frames}verdict {report.verdict}"
    if not report.complete:
        yield "stopped on request; the file is complete up to there"
    width = max(map(len, report.samples), default=0)
    for topic, count in sorted(report.samples.items()):
        yield f"  {topic:<{width}}  {count} messages"
    yield from (f"  problem: {problem}" for problem in report.problems)
    yield from (f"  note: {note}" for note in report.notes)
