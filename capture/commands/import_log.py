"""Command ``import``: a foreign log in, a session out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import echo, emit
from ..common.errors import ImportFormatError, UsageError
from ..common.files import check_output, is_file, why_no_file
from .topic_options import CONTRACT, JointTopicOptions

if TYPE_CHECKING:
    from ..exchange.can_import import ImportReport
    from ..exchange.column_map import ColumnMap
    from ..robot.model import Robot

_LEROBOT, _BAG = "is a LeRobot dataset, which names its columns itself", "is a bag of ROS"
_TABLE, _FRAMES = "holds no CAN frames", "holds CAN frames"
_OPTIONS = {
    _LEROBOT: ("--unit", "--episode"),
    _BAG: ("--command-topic", "--response-topic"),
    _TABLE: ("--commands", "--columns", "--map", "--unit", "--write-map", "--fps"),
    _FRAMES: ("--bus",),
}
"""Kind of a log to the options that are for it alone."""


def import_log(
    log: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    robot: Annotated[str | None, Parameter(name=["--robot", "-r"])] = None,
    commands: Path | None = None,
    columns: Path | None = None,
    map_: Annotated[tuple[str, ...], Parameter(name="--map", show_default=False)] = (),
    unit: Annotated[tuple[str, ...], Parameter(show_default=False)] = (),
    write_map: Path | None = None,
    fps: float | None = None,
    episode: int | None = None,
    bus: str | None = None,
    topics: JointTopicOptions = CONTRACT,
    force: bool = False,
    json: bool = False,
) -> int:
    """Turn another tool's log into a session.

    CAN traces (candump .log, .asc, .blf, .trc, python-can .csv and .db, .mf4) keep every frame and
    its direction; the robot's bus map defines which of them are joint commands, states and sensor
    values. Tables (CSV, .npz, .mat, .parquet, .pt), folders of them and LeRobot datasets need no
    robot: what their columns mean is guessed and shown, or given by --columns or --map. Tracks of
    markers along a body (columns NAME_x and NAME_y, DeepLabCut) become joint angles. Bags of ROS
    2 (MCAP, .db3, folders) and of ROS 1 (.bag) keep all joints, found by type, and every message
    that a session has a place for.

    Example: `undulog import trace.log -o run.mcap --robot arcsnake-joint`

    A bag of ROS: `undulog import BAG -o run.mcap`

    A table, with its commands in another: `undulog import states.csv --commands commands.csv
    -o run.mcap --write-map map.toml`, then, edited: `--columns map.toml`

    Tracks of an animal in a video: `undulog import tracks.csv --fps 120 -o run.mcap`

    A LeRobot dataset, a session an episode: `undulog import DATASET -o sessions`

    A CSV by options: `undulog import joint.csv -o run.mcap --robot arcsnake-joint --map time=time:s
    --map angle=joint01.position:deg,wrap=360`

    Args:
        log: The foreign log: a file, a folder of tables or of a bag, or a LeRobot dataset.
        output: The session to write, `.mcap`; a folder for the episodes of a dataset.
        robot: A shipped robot (snake25, snake13, snake13-planar, snake12-sts3215, so101,
            arcsnake-joint) or a robot TOML; required for CAN traces.
        commands: A table of commands, where `log` is one of states alone.
        columns: Column map of a table, as TOML.
        map_: One column of a table: `COLUMN=time:UNIT`, or `COLUMN=JOINT.QUANTITY:UNIT` with
            `,wrap=PERIOD`, `,scale=FACTOR`, `,offset=VALUE` where needed. May be repeated.
        unit: Unit for the guess, `QUANTITY=UNIT`: `position=deg`, `time=ms`. May be repeated.
        write_map: Write the guessed map here, to be edited.
        fps: Rows a second of a table without times.
        episode: The one episode of a LeRobot dataset to import.
        bus: The bus to decode, where the log has several; the first one by default.
        topics: Where commands and responses of a bag are.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    if map_ and log.is_dir():
        raise UsageError(f"{log} is a folder; --map is for one table")
    from ..common.process import interruptible
    from ..exchange.bag_import import import_bag, is_recording
    from ..exchange.can_import import import_can
    from ..exchange.lerobot_import import import_lerobot, is_lerobot
    from ..exchange.table_guess import parse_units
    from ..exchange.table_import import import_tables, open_mapped, open_tables
    from ..robot.description import load_robot

    if not log.is_dir() and not is_file(log):
        raise ImportFormatError(log, why_no_file(log))
    dataset = log.is_dir() and is_lerobot(log)
    if not dataset or output.suffix:
        why = f"a session is an .mcap file, not {output.suffix or 'nameless'}"
        check_output(output, (".mcap",), why, force=force)
    bag = not dataset and is_recording(log)
    table = not bag and _is_table(log)
    given = {"--commands": commands, "--columns": columns, "--map": map_, "--unit": unit}
    given |= {"--write-map": write_map, "--fps": fps, "--episode": episode, "--bus": bus}
    if topics != CONTRACT:
        given |= {"--command-topic": topics.command_topic, "--response-topic": topics}
    kind = _LEROBOT if dataset else _BAG if bag else _TABLE if table else _FRAMES
    _check_options(log, kind, [name for name, value in given.items() if value not in (None, ())])
    described = None if bag or robot is None else load_robot(robot)
    units = parse_units(unit)
    column_map = _column_map(described, columns, map_)
    with interruptible() as stop:
        if dataset:
            reports = import_lerobot(
                log, output, episode=episode, robot=described, units=units, force=force, stop=stop
            )
        elif bag:
            names = topics.names
            reports = [import_bag(log, output, robot=robot, topics=names, force=force, stop=stop)]
        elif not table:
            if described is None:
                raise UsageError(f"{log} holds CAN frames: --robot says what they mean")
            reports = [import_can(log, output, described, bus=bus, force=force, stop=stop)]
        else:
            by_map = described and column_map if commands is fps is None else None
            if by_map and log.suffix.lower() == ".csv":
                tables = open_mapped(log, by_map)
            else:
                tables = open_tables(log, commands, fps)
            report = import_tables(
                tables, output, robot=described, column_map=column_map, units=units,
                write_map=write_map, force=force, stop=stop,
            )  # fmt: skip
            reports = [report]
    code = _report_imports(reports, json=json)
    if dataset and len(reports) > 1 and not json:
        echo(f"what is wrong with which episode: undulog analyse {log}")
    return code


def _report_imports(reports: Sequence[ImportReport], *, json: bool) -> int:
    facts = [report.as_json() for report in reports]
    answer = facts[0] if len(facts) == 1 else {"sessions": facts}
    emit(answer, (line for report in reports for line in _import_lines(report)), as_json=json)
    return 0 if all(report.complete for report in reports) else 1


def _check_options(log: Path, kind: str, given: Sequence[str]) -> None:
    if wrong := [name for name in given if name not in _OPTIONS[kind]]:
        raise UsageError(f"{log} {kind}; {', '.join(wrong)}: for logs of another kind")


def _is_table(log: Path) -> bool:
    """Return whether a log is a table, or a folder of tables, and no log of CAN frames."""
    from ..exchange.can_logs import is_frame_csv
    from ..exchange.tables import TABLE_SUFFIXES

    return log.is_dir() or (log.suffix.lower() in TABLE_SUFFIXES and not is_frame_csv(log))


def _column_map(
    robot: Robot | None, columns: Path | None, options: tuple[str, ...]
) -> ColumnMap | None:
    """Return the column map that was given; None if it is to be guessed."""
    from ..exchange.column_map import column_map_from_options, read_column_map

    if columns is not None and options:
        raise UsageError("--columns MAP.toml or --map options, not both")
    if columns is not None:
        return read_column_map(columns, robot)
    return column_map_from_options(options, robot) if options else None


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
