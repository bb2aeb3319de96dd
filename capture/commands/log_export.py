"""Command ``log export``: sessions in, files of other tools out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from ..common.console import emit
from ..common.errors import UsageError
from .sessions import sessions_of

if TYPE_CHECKING:
    from ..exchange.export import ExportReport

Target = Literal["wide", "lerobot", "rosbag2", "tum", "foxglove-layout", "plotjuggler-layout"]

_FOR = {
    "bus": "CAN frames",
    "topics": "tables and layouts",
    "fps": "LeRobot",
    "task": "LeRobot",
    "frame": "trajectories",
}
"""Option to the outputs that have it."""


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
    options = {"bus": bus, "topics": topics, "fps": fps, "task": task, "frame": frame}
    given = {key: value for key, value in options.items() if value not in (None, ())}
    name, target = _target(to, output)
    target.check(name, sessions, given)
    read: Any = tuple(sessions_of(sessions)) if target.several else sessions[0]
    export = getattr(import_module(f"undulog.capture.exchange.{target.module}"), target.function)
    with interruptible() as stop:
        written: ExportReport = export(read, output, **given, force=force, stop=stop)
    source: Any = [str(path) for path in read] if target.several else str(read)
    facts = {"source": source, "output": str(output), **written.facts}
    facts["warnings"] = written.warnings
    lines = [
        f"{output}: {written.what}",
        *(f"  warning: {warning}" for warning in written.warnings),
    ]
    emit(facts, lines, as_json=json)


@dataclass(frozen=True)
class _Target:
    """A kind of output.

    Attributes:
        module: That of the exchange that writes it.
        function: Its function that does, which has the options as arguments.
        holds: What it has, for the refusal of options of other kinds.
        takes: The options that it has.
        several: Whether it takes several sessions.
    """

    module: str
    function: str
    holds: str
    takes: tuple[str, ...] = ()
    several: bool = False

    def check(self, name: str, sessions: tuple[Path, ...], given: Mapping[str, object]) -> None:
        """Refuse options and sessions that it doesn't take.

        Raises:
            UsageError: If there are some.
        """
        for option in given:
            if option not in self.takes:
                raise UsageError(f"--{option} is for {_FOR[option]}; {name} {self.holds}")
        if len(sessions) > 1 and not self.several:
            raise UsageError(f"{name} takes one session, not {len(sessions)}")
        if "fps" in self.takes and "fps" not in given:
            raise UsageError(f"{name} needs --fps, the frames a second of the dataset")


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


_FRAMES = _Target("export", "export_log", "has CAN frames", ("bus",))
_TABLE = _Target("export", "export_columns", "has joint columns", ("topics",))
_TARGETS = {
    "wide": _Target("wide_table", "export_wide", "has joint columns", ("topics",)),
    "lerobot": _Target(
        "lerobot_export", "export_lerobot", "has episodes", ("fps", "task"), several=True
    ),
    "rosbag2": _Target("rosbag2_export", "export_rosbag2", "has all messages"),
    "tum": _Target("tum", "export_tum", "has poses", ("frame",)),
    **{
        f"{name}-layout": _Target("plot_layouts", f"export_{name}_layout", "has plots", ("topics",))
        for name in ("foxglove", "plotjuggler")
    },
}
