"""Command ``import``: a foreign log in, a session out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from ..common.console import echo, emit
from ..common.errors import UsageError
from ..common.files import check_output
from .topic_options import CONTRACT, JointTopicOptions

if TYPE_CHECKING:
    from ..exchange.formats.format import Reader
    from ..exchange.reports import ImportReport


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
    from ..common.process import interruptible
    from ..exchange.import_options import ImportOptions
    from ..exchange.registry.registry import format_of, guarded, open_table

    if map_ and log.is_dir():
        raise UsageError(f"{log} is a folder; --map is for one table")
    form, reader = format_of(log)
    if output.suffix or not reader.several:
        why = f"a session is an .mcap file, not {output.suffix or 'nameless'}"
        check_output(output, (".mcap",), why, force=force)
    given = {"--commands": commands, "--columns": columns, "--map": map_, "--unit": unit}
    given |= {"--write-map": write_map, "--fps": fps, "--episode": episode, "--bus": bus}
    if topics != CONTRACT:
        given |= {"--command-topic": topics.command_topic, "--response-topic": topics}
    _check_options(log, reader, [name for name, value in given.items() if value not in (None, ())])
    with interruptible() as stop:
        options = ImportOptions(
            robot=robot, commands=None if commands is None else open_table(commands),
            columns=columns, map=map_, units=unit, write_map=write_map, fps=fps, episode=episode,
            bus=bus, topics=topics.names, force=force, stop=stop,
        )  # fmt: skip
        with guarded(form, log):
            reports = reader.into_session(log, output, options)
    code = _report_imports(reports, json=json)
    if len(reports) > 1 and not json:
        echo(f"what is wrong with which episode: undulog analyse {log}")
    return code


def _report_imports(reports: Sequence[ImportReport], *, json: bool) -> int:
    facts = [report.as_json() for report in reports]
    answer = facts[0] if len(facts) == 1 else {"sessions": facts}
    emit(answer, (line for report in reports for line in _import_lines(report)), as_json=json)
    return 0 if all(report.complete for report in reports) else 1


def _check_options(log: Path, reader: Reader, given: Sequence[str]) -> None:
    if wrong := [name for name in given if name not in reader.options]:
        raise UsageError(f"{log} {reader.holds}; {', '.join(wrong)}: for logs of another kind")


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
