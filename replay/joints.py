"""Joint angles: commanded, measured and the error between them.

``/joints/commanded``, ``/joints/measured`` and ``/joints/error`` hold one ``Scalars`` of all
joints each, in rad, row for row as logged; beside it the component ``Angle:degrees`` holds the same
in degrees, which is what the plots show. Joints that were sampled at times of their own get an
entity each below these, named after the first joint of those sampled together.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
from rerun.encodings import Float32Batch

from capture.palette import COMMANDED_RGB, joint_colors
from capture.robot import Plane, Robot

from .sampling import hold, mark_gaps
from .timeline import Clock
from .tracks import Table, Track, tables

COMMANDED = "/joints/commanded"
MEASURED = "/joints/measured"
ERROR = "/joints/error"
PLACES = "/joints/places"
DEGREES = "Angle:degrees"

_DEGREES = rr.ComponentDescriptor(DEGREES, archetype="Angle")

Color = tuple[int, int, int, int]

GREY: Color = (*COMMANDED_RGB, 255)
"""The grey of everything commanded."""


@dataclass(frozen=True)
class Series:
    """An entity with one plotted line a joint.

    Attributes:
        entity: Its path.
        names: The lines' names.
        component: The component that is plotted.
    """

    entity: str
    names: tuple[str, ...]
    component: str = "Scalars:scalars"


@dataclass(frozen=True)
class Places:
    """The joints that stand for head, middle and tail.

    Attributes:
        names: One to three joint names, head to tail.
        plane: The plane they bend, or None where no robot says.
    """

    names: tuple[str, ...]
    plane: Plane | None

    @property
    def labels(self) -> tuple[str, ...]:
        """``head``, ``middle`` and ``tail``, or the joints' names where there are fewer."""
        return ("head", "middle", "tail") if len(self.names) == 3 else self.names


def joint_palette(names: Sequence[str]) -> dict[str, Color]:
    """The colour that each joint keeps everywhere.

    Args:
        names: All joints, head to tail.

    Returns:
        sRGB and opacity by joint name.
    """
    if not names:
        return {}
    return {
        name: (int(color[0]), int(color[1]), int(color[2]), int(color[3]))
        for name, color in zip(names, joint_colors(len(names)), strict=True)
    }


def tracking_errors(measured: Sequence[Track], commanded: Sequence[Track]) -> tuple[Track, ...]:
    """Measured minus commanded angle, at the measurement's times.

    Args:
        measured: Measured angles [rad].
        commanded: Commanded angles [rad].

    Returns:
        A track for each joint that has both [rad]; the command is the last one given by then.
    """
    command = {track.name: track for track in commanded}
    return tuple(
        Track(
            track.name,
            track.t_ns,
            track.values - hold(command[track.name].t_ns, command[track.name].values, track.t_ns),
        )
        for track in measured
        if track.name in command
    )


def head_middle_tail(robot: Robot | None, moving: Sequence[Track]) -> Places | None:
    """Choose the joints that stand for the whole body.

    Args:
        robot: The robot; without it all joints count as one plane.
        moving: Angles by which the busiest plane is told: commands, or else measurements [rad].

    Returns:
        First, middle and last joint of the plane that moves most, or None without joints.
    """
    swing = {track.name: float(np.nanstd(track.values)) for track in moving}
    if not swing:
        return None
    if robot is None:
        names, plane = tuple(swing), None
    else:
        planes = {
            plane: [joint.name for joint in robot.joints if joint.plane is plane] for plane in Plane
        }
        plane = max(Plane, key=lambda p: max((swing.get(n, -1.0) for n in planes[p]), default=-1.0))
        names = tuple(name for name in planes[plane] if name in swing) or tuple(swing)
    chosen = dict.fromkeys((names[0], names[len(names) // 2], names[-1]))
    return Places(tuple(chosen), plane)


def log_angles(
    rec: rr.RecordingStream,
    clock: Clock,
    entity: str,
    tracks: Sequence[Track],
    palette: Mapping[str, Color] | None = None,
) -> tuple[Series, ...]:
    """Write one kind of angle of all joints.

    Args:
        rec: The recording.
        clock: Its timelines.
        entity: E.g. ``/joints/measured``.
        tracks: The angles [rad].
        palette: Colour by joint name; None for the grey of everything commanded.

    Returns:
        What was written; one series where all joints share their times.
    """
    return tuple(
        log_table(rec, clock, path, table, palette, degrees=True)
        for path, table in _placed(entity, tables(tracks))
    )


def log_scalars(
    rec: rr.RecordingStream,
    clock: Clock,
    entity: str,
    tracks: Sequence[Track],
    palette: Mapping[str, Color] | None = None,
) -> tuple[Series, ...]:
    """Write a quantity of all joints that needs no other unit.

    Args:
        rec: The recording.
        clock: Its timelines.
        entity: Where to.
        tracks: The values.
        palette: Colour by joint name; None for grey.

    Returns:
        What was written.
    """
    return tuple(
        log_table(rec, clock, path, table, palette, degrees=False)
        for path, table in _placed(entity, tables(tracks))
    )


def log_places(
    rec: rr.RecordingStream,
    clock: Clock,
    places: Places,
    *,
    measured: Sequence[Track],
    commanded: Sequence[Track],
    palette: Mapping[str, Color],
) -> None:
    """Write head, middle and tail once more in degrees, for a plot that can be read at a glance.

    Args:
        rec: The recording.
        clock: Its timelines.
        places: The joints.
        measured: Measured angles [rad].
        commanded: Commanded angles [rad].
        palette: Colour by joint name.
    """
    for kind, tracks, width in (("commanded", commanded, 1.0), ("measured", measured, 2.0)):
        by_name = {track.name: track for track in tracks}
        for name, label in zip(places.names, places.labels, strict=True):
            if name not in by_name:
                continue
            track = by_name[name]
            entity = f"{PLACES}/{rr.escape_entity_path_part(label)}/{kind}"
            color = palette[name] if kind == "measured" else GREY
            title = label if kind == "measured" else "command"
            look = rr.SeriesLines(
                names=f"{name} {title}" if title != name else name,
                colors=color,
                widths=width,
            )
            rec.log(entity, look, static=True)
            t_ns, values = mark_gaps(track.t_ns, track.values[:, None])
            for rows, times in clock.rows(t_ns):
                degrees = np.rad2deg(values[rows, 0])
                rec.send_columns(entity, times, rr.Scalars.columns(scalars=degrees))


def _placed(entity: str, parts: Sequence[Table]) -> list[tuple[str, Table]]:
    if len(parts) == 1:
        return [(entity, parts[0])]
    return [(part_entity(entity, part.names[0]), part) for part in parts]


def part_entity(entity: str, first: str) -> str:
    """Where joints go that were sampled at times of their own.

    Args:
        entity: E.g. ``/joints/measured``.
        first: The first joint of those sampled together.

    Returns:
        The path of their entity.
    """
    return f"{entity}/{rr.escape_entity_path_part(first)}"


def log_table(
    rec: rr.RecordingStream,
    clock: Clock,
    entity: str,
    table: Table,
    palette: Mapping[str, Color] | None,
    *,
    degrees: bool,
) -> Series:
    """Write joints that were sampled together.

    Args:
        rec: The recording.
        clock: Its timelines.
        entity: Where to.
        table: Their values.
        palette: Colour by joint name; None for grey.
        degrees: Whether the values are angles [rad], to be plotted in degrees.

    Returns:
        What was written.
    """
    colors = [GREY if palette is None else palette.get(name, GREY) for name in table.names]
    rec.log(entity, rr.SeriesLines(names=list(table.names), colors=colors), static=True)
    t_ns, values = mark_gaps(table.t_ns, table.values)
    for rows, times in clock.rows(t_ns):
        size = np.full(rows.stop - rows.start, len(table.names))
        columns = [*rr.Scalars.columns(scalars=values[rows].ravel()).partition(size)]
        if degrees:
            shown = np.rad2deg(values[rows].ravel()).astype(np.float32)
            columns.append(rr.ComponentColumn(_DEGREES, Float32Batch(shown)).partition(size))
        rec.send_columns(entity, times, columns)
    return Series(entity, table.names, DEGREES if degrees else "Scalars:scalars")
