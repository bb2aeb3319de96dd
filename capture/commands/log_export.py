"""Command ``log export``: sessions in, files of other tools out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from ..common.console import emit
from ..common.errors import UsageError
from .sessions import sessions_of

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
    to: Target | str | None = None,
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
    from ..exchange.registry.registry import format_for, guarded

    if not sessions:
        raise UsageError("log export needs a session, e.g. undulog log export run.mcap -o run.csv")
    options = {"bus": bus, "topics": topics, "fps": fps, "task": task, "frame": frame}
    given = {key: value for key, value in options.items() if value not in (None, ())}
    name, form, writer = format_for(output, to)
    for option in given:
        if option not in writer.options:
            raise UsageError(f"--{option} is for {_FOR[option]}; {name} {writer.holds}")
    if len(sessions) > 1 and not writer.several:
        raise UsageError(f"{name} takes one session, not {len(sessions)}")
    read = sessions_of(sessions) if writer.several else list(sessions)
    with interruptible() as stop, guarded(form, output):
        written = writer.out_of_session(read, output, **given, force=force, stop=stop)
    source = [str(path) for path in read] if writer.several else str(read[0])
    facts = {"source": source, "output": str(output), **written.facts}
    facts["warnings"] = written.warnings
    lines = [
        f"{output}: {written.what}",
        *(f"  warning: {warning}" for warning in written.warnings),
    ]
    emit(facts, lines, as_json=json)
