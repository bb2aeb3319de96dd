"""Command ``log export``: sessions in, files of other tools out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..common.console import emit
from ..common.errors import UsageError
from .sessions import sessions_of

if TYPE_CHECKING:
    from ..common.process import StopRequest
    from ..exchange.plot_layouts import LayoutReport

Target = Literal["wide", "lerobot", "rosbag2", "tum", "foxglove-layout", "plotjuggler-layout"]


def log_export(
    *sessions: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    to: Target | None = None,
    bus: str | None = None,
    topics: Annotated[tuple[str, ...], Parameter(consume_multiple=True, show_default=False)] = (),
    fps: int | None = None,
    task: str | None = None,
    frame: str | None = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a session for other tools: raw CAN frames, joint columns, or what --to names.

    Without --to the suffix of the output selects the format. Frames: .log (candump), .blf and .asc
    (Vector), .mcap (ROS 2, one can_msgs/msg/Frame a frame). Columns: .csv and .parquet, one row a
    sample of a joint at its own time. What a format can't hold is reported in a warning.

    --to wide writes .csv or .parquet with a column for each joint and quantity, and a row for each
    time at which a joint was sampled; nothing is resampled. --to lerobot writes a LeRobot dataset
    v3, an episode a session: --fps frames a second, each with the last sample of every joint and
    the time it was sampled. --to rosbag2 writes a folder for ros2 bag, with the session's messages.
    --to tum writes the pose of the base, or of --frame, as a TUM trajectory. --to foxglove-layout
    (.json) and plotjuggler-layout (.xml) write a layout that plots command and state of each joint.

    Example: `undulog log export run.mcap -o trace.log`

    For Vector's tools: `undulog log export run.mcap -o trace.blf`, or `-o trace.asc`

    For ROS 2: `undulog log export run.mcap -o frames.mcap`

    For pandas: `undulog log export run.mcap -o run.csv`, or `-o states.parquet --topics
    /joint_states`

    A column a joint: `undulog log export run.mcap --to wide -o run.csv`

    For training: `undulog log export runs/*.mcap --to lerobot --fps 50 -o dataset`

    Args:
        sessions: The session; for LeRobot several, folders of them or patterns.
        output: The file to write, or the folder.
        to: The format, where the suffix doesn't select it.
        bus: The bus whose frames to write; all by default.
        topics: The JointState topics whose columns to write; commands and whatever the joints
            measure by default.
        fps: Frames a second of a LeRobot dataset.
        task: What the robot does, for a LeRobot dataset; what the session states by default.
        frame: The frame of a trajectory; the base by default, whose pose is in /odom.
        force: Replace an existing output.
        json: Report as one JSON object.
    """
    from ..common.process import interruptible

    if not sessions:
        raise UsageError("log export needs a session, e.g. undulog log export run.mcap -o run.csv")
    options = _Options(bus, topics, fps, task, frame)
    name, target = _target(to, output)
    target.check(name, sessions, options)
    if target.several:
        sessions = tuple(sessions_of(sessions))
    with interruptible() as stop:
        written = target.write(_Request(sessions, output, options, force, stop))
    source: Any = [str(path) for path in sessions] if target.several else str(sessions[0])
    facts = {"source": source, "output": str(output), **written.facts}
    facts["warnings"] = written.warnings
    lines = [f"{output}: {written.what}", *(f"  warning: {each}" for each in written.warnings)]
    emit(facts, lines, as_json=json)


@dataclass(frozen=True)
class _Options:
    """The options that some formats have, as given; the default of each is that of its format."""

    bus: str | None = None
    topics: tuple[str, ...] = ()
    fps: int | None = None
    task: str | None = None
    frame: str | None = None


@dataclass(frozen=True)
class _Request:
    sessions: tuple[Path, ...]
    output: Path
    options: _Options
    force: bool
    stop: StopRequest

    @property
    def common(self) -> dict[str, Any]:
        """Arguments of every export."""
        return {"force": self.force, "stop": self.stop}


@dataclass(frozen=True)
class _Written:
    """What was written: facts for JSON, a phrase for people, and warnings."""

    facts: dict[str, Any]
    what: str
    warnings: list[str]


@dataclass(frozen=True)
class _Target:
    """A kind of output.

    Attributes:
        holds: What it has, for the refusal of options of other kinds.
        takes: The options that it has.
        several: Whether it takes several sessions.
    """

    write: Callable[[_Request], _Written]
    holds: str
    takes: frozenset[str] = field(default_factory=frozenset[str])
    several: bool = False

    def check(self, name: str, sessions: tuple[Path, ...], options: _Options) -> None:
        """Refuse options and sessions that it doesn't take.

        Raises:
            UsageError: If there are some.
        """
        for each in fields(options):
            if getattr(options, each.name) != each.default and each.name not in self.takes:
                raise UsageError(f"--{each.name} is for {_FOR[each.name]}; {name} {self.holds}")
        if len(sessions) > 1 and not self.several:
            raise UsageError(f"{name} takes one session, not {len(sessions)}")


def _target(to: str | None, output: Path) -> tuple[str, _Target]:
    """Return the kind of output and its name in messages."""
    from ..exchange.export import TABLE_FORMATS
    from ..exchange.frame_formats import FRAME_FORMATS

    if to is not None:
        return f"--to {to}", _TARGETS[to]
    suffix = output.suffix.lower()
    if suffix in FRAME_FORMATS:
        return f"a {suffix} file", _FRAMES
    if suffix in TABLE_FORMATS:
        return f"a {suffix} file", _TABLE
    valid = ", ".join([*FRAME_FORMATS, *TABLE_FORMATS])
    raise UsageError(
        f"{output}: no format has the suffix {suffix!r}; valid: {valid}, or --to "
        f"{', '.join(_TARGETS)}"
    )


def _frames(request: _Request) -> _Written:
    from ..exchange.export import export_log

    (session,), options = request.sessions, request.options
    trace = export_log(session, request.output, bus=options.bus, **request.common)
    count = sum(trace.buses.values())
    what = f"{count} frames of {', '.join(trace.buses)}, in the format of {trace.title}"
    return _Written({"frames": count, "buses": trace.buses}, what, trace.warnings)


def _table(request: _Request) -> _Written:
    from ..exchange.export import export_columns

    (session,), options = request.sessions, request.options
    table = export_columns(session, request.output, topics=options.topics, **request.common)
    count = sum(table.rows.values())
    what = f"{count} rows of {', '.join(table.rows)}"
    return _Written({"rows": count, "topics": table.rows}, what, table.warnings)


def _wide(request: _Request) -> _Written:
    from ..exchange.wide_table import export_wide

    (session,), options = request.sessions, request.options
    table = export_wide(session, request.output, topics=options.topics, **request.common)
    what = f"{table.rows} rows of {len(table.columns)} columns"
    return _Written({"rows": table.rows, "columns": table.columns}, what, table.warnings)


def _lerobot(request: _Request) -> _Written:
    from ..exchange.lerobot_export import export_lerobot

    options = request.options
    if options.fps is None:
        raise UsageError("--to lerobot needs --fps, the frames a second of the dataset")
    report = export_lerobot(
        request.sessions, request.output, fps=options.fps, task=options.task, **request.common
    )
    count = len(report.episodes)
    what = f"{sum(report.episodes)} frames in {count} episode{'' if count == 1 else 's'}"
    return _Written({"episodes": report.episodes, "fps": options.fps}, what, report.warnings)


def _rosbag2(request: _Request) -> _Written:
    from ..exchange.rosbag2_export import export_rosbag2

    (session,) = request.sessions
    report = export_rosbag2(session, request.output, **request.common)
    count = sum(report.messages.values())
    what = f"{count} messages of {len(report.messages)} topics"
    return _Written({"messages": report.messages}, what, report.warnings)


def _tum(request: _Request) -> _Written:
    from ..exchange.tum import export_tum

    (session,), options = request.sessions, request.options
    report = export_tum(session, request.output, frame=options.frame, **request.common)
    what = f"{report.poses} poses of {report.frame} in {report.parent}, from {report.topic}"
    facts = {"poses": report.poses, "frame": report.frame, "parent": report.parent}
    return _Written(facts | {"topic": report.topic}, what, report.warnings)


def _layout(request: _Request, export: Callable[..., LayoutReport]) -> _Written:
    (session,), options = request.sessions, request.options
    report = export(session, request.output, topics=options.topics, force=request.force)
    what = f"plots of {len(report.joints)} joints"
    return _Written({"joints": report.joints}, what, report.warnings)


def _foxglove(request: _Request) -> _Written:
    from ..exchange.plot_layouts import export_foxglove_layout

    return _layout(request, export_foxglove_layout)


def _plotjuggler(request: _Request) -> _Written:
    from ..exchange.plot_layouts import export_plotjuggler_layout

    return _layout(request, export_plotjuggler_layout)


_FOR = {
    "bus": "CAN frames",
    "topics": "tables and layouts",
    "fps": "LeRobot",
    "task": "LeRobot",
    "frame": "trajectories",
}
"""Option to the outputs that have it."""

_FRAMES = _Target(_frames, "has CAN frames", frozenset({"bus"}))
_TABLE = _Target(_table, "has joint columns", frozenset({"topics"}))
_TARGETS = {
    "wide": _Target(_wide, "has joint columns", frozenset({"topics"})),
    "lerobot": _Target(_lerobot, "has episodes", frozenset({"fps", "task"}), several=True),
    "rosbag2": _Target(_rosbag2, "has all messages"),
    "tum": _Target(_tum, "has poses", frozenset({"frame"})),
    "foxglove-layout": _Target(_foxglove, "has plots", frozenset({"topics"})),
    "plotjuggler-layout": _Target(_plotjuggler, "has plots", frozenset({"topics"})),
}
"""Value of ``--to`` to the kind of output."""
