"""The body in its surroundings, drawn stretch by stretch."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.robot.model import Robot

from ...content.entities import Color, Places
from ...samples.quantities import mechanical_power
from ...samples.stretches import Span, Stretch
from ...samples.timeline import Clock
from . import body, markers, ranges
from . import markers as marks
from .motion import HeadPath, assemble, frames_of
from .surroundings import log_surroundings, log_trail, world_of


class Scene:
    """The 3D scene of a session with a robot whose joints were measured."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clock: Clock,
        session: SessionView,
        robot: Robot,
        head: HeadPath,
        *,
        places: Places | None,
        palette: Mapping[str, Color],
        limit_w: float | None,
        warnings: list[str],
        span: Span,
    ) -> None:
        """Write what doesn't move, and the head's trail.

        Args:
            rec: The recording.
            clock: Its timelines.
            session: The session.
            robot: The robot.
            head: Where its head was.
            places: Joints that stand for the body, or None.
            palette: Colour by joint name.
            limit_w: Power at which a segment's colour is full [W]; None where none is known.
            warnings: Grows by a sentence where the surroundings can't be drawn.
            span: The part of the trail that is drawn.
        """
        self._rec, self._clock, self._robot = rec, clock, robot
        self._places, self._palette, self._limit_w = places, palette, limit_w
        self.named: list[str] = []
        """Joints of modules that a test names, which carry a mark."""
        self._frames = frames_of(head, session.end_ns)
        self._sparse = np.flatnonzero(self._frames.sparse)
        at_ns = self._frames.head.t_ns[self._sparse]
        self._readings = ranges.read_ranges(session, robot, at_ns)
        rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        world = world_of(session, warnings)
        if world is not None:
            log_surroundings(rec, world)
        if head.tracked:
            log_trail(rec, clock, head, span)

    def write(self, stretch: Stretch) -> None:
        """Draw a stretch.

        Args:
            stretch: Its samples.
        """
        rows = stretch.span.rows(self._frames.head.t_ns)
        if rows.stop <= rows.start:
            return
        frames = self._frames.between(rows)
        columns = stretch.columns
        motion = assemble(
            self._robot,
            frames.head,
            positions=columns.get(("/joint_states", "position"), ()),
            commands=columns.get(("/joint_commands", "position"), ()),
            power=mechanical_power(columns),
        )
        sparse = np.flatnonzero(frames.sparse)
        body.log_body(self._rec, self._clock, motion, limit_w=self._limit_w)
        body.log_ghost(self._rec, self._clock, motion, sparse)
        if self._readings.sensors:
            own = slice(*np.searchsorted(self._sparse, [rows.start, rows.stop]).tolist())
            ranges.log_rays(
                self._rec,
                self._clock,
                motion,
                sparse,
                sensors=self._readings.sensors,
                reading=self._readings.distance[own],
            )
        marks.log_marks(self._rec, self._clock, motion, self.named, sparse)
        if self._places is not None:
            markers.log_markers(
                self._rec, self._clock, motion, self._places, self._palette, named=sparse
            )
