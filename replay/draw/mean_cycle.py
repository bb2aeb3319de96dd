"""The mean cycle as entities of its own on a timeline of its own.

``ensemble_cycle`` runs from 0 to 360 degrees of the gait's phase, one number a degree, and the
viewer loops it at the gait's own speed. Nothing of it is on the session's timelines but the body's
first shape, so that its view isn't black there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun.components import FillMode

from undulog.analysis.results.analysis import Analysis
from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_colors
from undulog.capture.robot.model import Robot

from ..samples.content import GREY, Color, MeanCycle, PlottedSeries, line_title
from ..samples.quantities import mechanical_power, segment_power
from ..samples.timeline import ENSEMBLE_CYCLE, DrawnSpan, SpanSamples, TimeColumns
from ..samples.tracks import Columns, Track, read_columns
from .body import Look, capsule_columns, capsule_poses, power_colors
from .ensemble import DEGREES, CyclePhase, MeanCycles, body_frame, falsified, mean_cycles, pace_of
from .lines import log_look

ENSEMBLE = "/ensemble"
BODY = f"{ENSEMBLE}/body"
PLACES = f"{ENSEMBLE}/places"
ABOUT = f"{ENSEMBLE}/about"

MOST_S = 600.0
"""The mean cycle is taken of so much at most [s], so that an hour needs no more memory."""

_TOPICS = ("/joint_states", "/joint_commands")

_WHITE = (255, 255, 255, 255)
_FAINT = 110  # opacity of the lines at the ends of an interval


class Averaged:
    """Samples that are averaged: at most :data:`MOST_S` from the start of the analysed window on.

    They are kept from the stretches that are drawn, or else read.
    """

    def __init__(self, clock: TimeColumns, analysis: Analysis | None) -> None:
        """Keep nothing by now.

        Args:
            analysis: The session's analysis, or None.
        """
        windows = () if analysis is None else analysis.gait.windows
        late_ns = round(windows[0].start_s * 1e9) if windows else 0
        start_ns = clock.start_ns + late_ns
        self._window = DrawnSpan(start_ns, start_ns + round(MOST_S * 1e9))
        self._kept: dict[tuple[str, str], dict[str, list[Track]]] = {}

    def keep(self, stretch: SpanSamples) -> None:
        """Keep copies of what is averaged of the samples in a stretch's span."""
        for key, tracks in stretch.columns.items():
            for track in tracks if key[0] in _TOPICS else ():
                spanned, averaged = (span.rows(track.t_ns) for span in (stretch.span, self._window))
                rows = slice(max(spanned.start, averaged.start), min(spanned.stop, averaged.stop))
                if rows.start < rows.stop:
                    part = Track(track.name, track.t_ns[rows].copy(), track.values[rows].copy())
                    self._kept.setdefault(key, {}).setdefault(track.name, []).append(part)

    @property
    def kept(self) -> Columns:
        """All samples that were kept."""
        return {
            key: tuple(
                Track(
                    name,
                    np.concatenate([part.t_ns for part in parts]),
                    np.concatenate([part.values for part in parts]),
                )
                for name, parts in tracks.items()
            )
            for key, tracks in self._kept.items()
        }

    def read(self, session: SessionView, topics: Mapping[str, Sequence[str]]) -> Columns:
        """Read them.

        Args:
            topics: JointState topic to the fields that come.
        """
        drawn = {topic: fields for topic, fields in topics.items() if topic in _TOPICS}
        start_ns, stop_ns = self._window.start_ns, self._window.stop_ns
        columns = read_columns(session, drawn, start_ns=start_ns, stop_ns=stop_ns)
        session.forget()
        return columns


def log_mean_cycle(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    columns: Columns,
    look: Look,
    *,
    analysis: Analysis | None,
    warnings: list[str],
) -> MeanCycle | None:
    """Average the cycles and draw the mean.

    Args:
        columns: From :class:`Averaged`.
        clock: The session's timelines; their rhythm is the phase, where one was logged.
        analysis: The session's analysis, for its window and what is wrong with samples, or None.
        warnings: Grows by a sentence where joints are left out.

    Returns:
        What was written; None where there is no phase, or no measured joint has a whole cycle.
    """
    measured = columns.get(("/joint_states", "position"), ())
    commanded = columns.get(("/joint_commands", "position"), ())
    pace = pace_of(
        clock.rhythm, analysis, commanded=commanded, places=look.places, start_ns=clock.start_ns
    )
    if pace is None:
        return None
    pace = pace.shortened(pace.start_s + MOST_S, clock.start_ns)
    if false := falsified(analysis, pace.start_s, pace.stop_s):
        warnings.append(
            f"the mean cycle leaves out {', '.join(false)}: a sensor falsifies the angles"
        )
    moved = mean_cycles([track for track in measured if track.name not in false], pace)
    if moved is None:
        return None
    asked = mean_cycles(commanded, pace)
    power = mean_cycles(mechanical_power(columns), pace)
    steady = analysis is None or analysis.gait.frequency_hz.value is not None
    about = _about(pace, moved, steady=steady)
    rec.log(ABOUT, rr.TextDocument(about, media_type="text/markdown"), static=True)
    error: tuple[PlottedSeries, ...] = ()
    if asked is not None:
        both = tuple(name for name in moved.names if name in asked.names)
        difference = np.degrees(moved.ordered(both) - asked.ordered(both))
        error = _log_joints(rec, f"{ENSEMBLE}/error", both, difference, look.palette)
    angles = np.degrees(moved.value.T)
    spent: tuple[PlottedSeries, ...] = ()
    if power is not None:
        spent = _log_joints(rec, f"{ENSEMBLE}/power", power.names, power.value.T, look.palette)
    return MeanCycle(
        period_s=pace.period_s,
        has_body=_log_body(rec, clock, look, (moved, asked, power)),
        has_places=_log_places(rec, look, moved, asked),
        measured=_log_joints(rec, f"{ENSEMBLE}/measured", moved.names, angles, look.palette),
        error=error,
        power=spent,
    )


def _times() -> list[rr.TimeColumn]:
    return [rr.TimeColumn(ENSEMBLE_CYCLE, sequence=DEGREES)]


def _about(pace: CyclePhase, moved: MeanCycles, *, steady: bool) -> str:
    fewest, most = int(moved.cycles.min()), int(moved.cycles.max())
    count = f"{fewest} to {most} cycles" if fewest < most else f"{most} cycle{'s' * (most > 1)}"
    zero = "at the crest of the first driven joint's command (no phase was logged)"
    if pace.logged:
        zero = "where the phase on `/gait` is a multiple of 360°"
    interval = "One cycle has no scatter, so there is no interval."
    if most > 1:
        interval = "Thin lines are the 95 % interval of the mean."
    if not steady:
        interval += " No steady gait was found: what changes as it goes is mixed here."
    return (
        f"**To play it, choose `{ENSEMBLE_CYCLE}` in the time panel below** instead of "
        "`session_time`: 0 to 360 degrees of the gait's phase, looped at the gait's own speed.\n\n"
        f"Mean of {count}, {pace.start_s:.1f} to {pace.stop_s:.1f} s, of {pace.period_s:.3g} s "
        f"each. Phase 0 is {zero}. {interval}\n\n"
        "Each sample keeps its own time and phase: cycles are interpolated about a harmonic fit "
        "and then averaged, samples are not folded. The body is drawn in the frame of its own "
        "mean position and orientation; grey is commanded.\n"
    )


def _log_body(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    look: Look,
    cycles: tuple[MeanCycles, MeanCycles | None, MeanCycles | None],
) -> bool:
    """Draw the body, measured and commanded; ``cycles`` are of those two and of power."""
    robot = look.robot
    moved, asked, power = cycles
    if robot is None or robot.joint_names[0] not in moved.names:
        return False
    names = robot.joint_names
    rec.log(BODY, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    shape = (DEGREES.size, len(robot.links), 4)
    colors = np.broadcast_to(joint_colors(len(robot.links)), shape)
    if power is not None and look.limit_w is not None:
        colors = power_colors(segment_power(power.ordered(names)), look.limit_w)
    solid = rr.Capsules3D.from_fields(fill_mode=FillMode.Solid)
    _log_shapes(rec, clock, ("measured", solid), robot, (moved.ordered(names), colors))
    centre, _ = body_frame(robot, moved.ordered(names))
    above = np.nanmean(centre[:, 0], axis=0)
    above[2] += 7.0 * robot.links[0].radius
    label = rr.Points3D(
        [above],
        labels="head",
        show_labels=True,
        radii=rr.Radius.ui_points(0.5),
        colors=_WHITE,
    )
    rec.log(f"{BODY}/head", label, static=True)
    if asked is not None:
        wire = rr.Capsules3D.from_fields(
            fill_mode=FillMode.MajorWireframe, line_radii=rr.Radius.ui_points(0.5)
        )
        grey = np.broadcast_to(np.array(GREY, dtype=np.uint8), shape)
        _log_shapes(rec, clock, ("commanded", wire), robot, (asked.ordered(names), grey))
    return True


def _log_shapes(
    rec: rr.RecordingStream,
    clock: TimeColumns,
    kind: tuple[str, rr.Capsules3D],
    robot: Robot,
    drawn: tuple[FloatArray, NDArray[np.uint8]],
) -> None:
    """Draw the body at each phase by its angles and colours; the first on the session too."""
    (name, look), (angles, colors) = kind, drawn
    origin, quaternion = capsule_poses(robot, *body_frame(robot, angles))
    whole, still = f"{BODY}/{name}", f"{BODY}/on_session_time/{name}"
    for entity in (whole, still):
        rec.log(entity, look, static=True)
    rec.flush()  # else what comes first in the file is chance
    rec.send_columns(whole, _times(), capsule_columns(robot, (origin, quaternion), colors))
    first = capsule_columns(robot, (origin[:1], quaternion[:1]), colors[:1])
    for _, times in clock.rows(np.array([clock.start_ns], dtype=np.int64)):
        rec.send_columns(still, times, first)


def _log_places(
    rec: rr.RecordingStream, look: Look, moved: MeanCycles, asked: MeanCycles | None
) -> bool:
    drawn = False
    if look.places is None:
        return drawn
    for name, label in look.places.labelled.items():
        path = f"{PLACES}/{rr.escape_entity_path_part(label)}"
        if asked is not None and name in asked.names:
            line = rr.SeriesLines(names="command", colors=GREY, widths=1.0)
            _log_line(rec, f"{path}/commanded", line, asked.of(name)[0])
        if name not in moved.names:
            continue
        drawn = True
        mean, half = moved.of(name)
        color = look.palette[name]
        if np.isfinite(half).any():
            line = rr.SeriesLines(names="95 % interval", colors=(*color[:3], _FAINT), widths=1.0)
            _log_line(rec, f"{path}/low", line, mean - half)
            _log_line(rec, f"{path}/high", line, mean + half)
        line = rr.SeriesLines(names=line_title(name, label), colors=color, widths=2.0)
        _log_line(rec, f"{path}/measured", line, mean)
    return drawn


def _log_line(
    rec: rr.RecordingStream, entity: str, line: rr.SeriesLines, angle_rad: FloatArray
) -> None:
    rec.log(entity, line, static=True)
    _send(rec, entity, np.degrees(angle_rad)[:, None])


def _send(rec: rr.RecordingStream, entity: str, values: FloatArray) -> None:
    """Write lines over the phases; ``values`` of shape (p, k)."""
    rec.flush()  # else what comes first in the file is chance
    columns = rr.Scalars.columns(scalars=values.ravel())
    rec.send_columns(entity, _times(), columns.partition([values.shape[1]] * len(values)))


def _log_joints(
    rec: rr.RecordingStream,
    entity: str,
    names: tuple[str, ...],
    values: FloatArray,
    palette: Mapping[str, Color],
) -> tuple[PlottedSeries, ...]:
    """Draw a line for each joint; ``values`` of shape (p, k)."""
    if not names:
        return ()
    log_look(rec, entity, names, palette)
    _send(rec, entity, values)
    return (PlottedSeries(entity, names),)
