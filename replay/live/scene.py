"""Draws a recording while it is made, with the entities, colours and views of its replay.

What a sample says by itself is drawn at once; what needs several samples (the body, power, the
tracking error) is computed over the last seconds, with the replay's own functions, and drawn as far
as all that it needs has come.
"""

from __future__ import annotations

import time
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray, IntArray

from ..draw.drawing import palette_of, start_of
from ..draw.facts import code, escaped, log_facts
from ..draw.plots import gait, joints
from ..draw.plots import joints as power
from ..draw.scene import body
from ..draw.scene import body as markers
from ..draw.scene import stage as ranges
from ..draw.scene import stage as trail
from ..draw.scene.body import body_title
from ..draw.scene.motion import BODY_RATE_HZ, SPARSE_RATE_HZ, HeadPath, Motion, assemble, still_head
from ..layout import build_blueprint
from ..samples import content as entities
from ..samples import quantities
from ..samples.content import Content, Signal, Start, signal_title
from ..samples.quantities import DRAWN, SIGNALS, power_limit, topic_entity
from ..samples.sampling import hold
from ..samples.timeline import Clock
from ..samples.tracks import Track
from .cycles import CycleMeter
from .decode import Batch, LiveLog
from .inbox import Fresh, Window
from .plot import CycleBars, LivePlot

_LAYOUT_EVERY_S = 1.0
_FACTS_EVERY_S = 2.0
_PLACES_EVERY_S = 0.2
_TAIL_NS = round(1e9 / trail.TRAIL_RATE_HZ)
_CLEARER = 2.0
"""Another plane's joints are plotted once they swing so many times as far."""


class LiveScene:
    """One recording as it grows."""

    def __init__(
        self, rec: rr.RecordingStream, log: LiveLog, session_id: str, epoch_ns: int
    ) -> None:
        """Draw nothing yet.

        Args:
            log: What is known of the recording.
            session_id: The session's id.
            epoch_ns: Where ``session_time`` starts [Unix ns].
        """
        self._rec, self._log, self._session_id = rec, log, session_id
        self._clock = Clock(epoch_ns)
        self._window, self._fresh = Window(), Fresh()
        self._measured = LivePlot(entities.MEASURED, degrees=True)
        self._commanded = LivePlot(entities.COMMANDED, degrees=True)
        self._errors = LivePlot(entities.ERROR, degrees=True)
        self._joint_power = LivePlot(entities.MECHANICAL)
        self._meter, self._bars = CycleMeter(epoch_ns), CycleBars()
        self._signals: dict[str, LivePlot] = {}
        self._palette: dict[str, entities.Color] = {}
        self._of_joints: dict[str, bool] = {}
        self._places: entities.Places | None = None
        self._place_plots: dict[tuple[str, tuple[str, ...]], LivePlot] = {}
        self._start: Start | None = None
        self._origin_ns: int | None = None
        self._limit_w: float | None = None
        self._mode: str | None = None
        self._mode_ns = 0
        self._modes = 0
        self._has_events = self._has_power = False
        self._trail_end: tuple[int, FloatArray] | None = None
        self._laid_out: tuple[object, ...] = ()
        self._layout_at = self._facts_at = self._places_at = 0.0

    @property
    def content(self) -> Content:
        """What has been drawn so far."""
        return Content(
            robot=self._log.robot,
            start=self._start,
            power_limit_w=self._limit_w,
            places=self._places,
            commanded=self._commanded.series,
            measured=self._measured.series,
            errors=self._errors.series,
            has_power=self._has_power,
            joint_power=self._joint_power.series,
            charts=self._bars.charts,
            cycles=self._bars.cycles,
            modes=min(self._modes, 2),  # one or several: more lay out nothing anew
            has_events=self._has_events,
            signals=tuple(
                Signal(
                    signal_title(topic, self._log.unit(topic)),
                    plot.series,
                    self._of_joints[topic],
                )
                for topic, plot in self._signals.items()
            ),
            live=True,
        )

    def draw(self, batch: Batch, dropped: int = 0) -> None:
        """Draw new samples.

        Args:
            dropped: Messages that could not be shown so far.
        """
        self._window.add(batch)
        names = [
            track.name
            for track in self._window.tracks("/joint_states")
            or self._window.tracks("/joint_commands")
        ]
        palette = palette_of(self._log.robot, names)
        self._draw_angles(batch, palette)
        self._draw_power(palette)
        self._draw_signals(batch, palette)
        self._draw_words(batch)
        self._draw_body(palette)
        for cycle in self._meter.add(batch, self._log.robot):
            self._bars.take(cycle)
        self._bars.write(self._rec, self._clock, palette)
        self._palette = palette
        self._lay_out(dropped)

    def finish(self, dropped: int = 0) -> None:
        """Say that the recording has ended.

        Args:
            dropped: Messages that could not be shown.
        """
        self._bars.write(self._rec, self._clock, self._palette, everything=True)
        self._layout_at = self._facts_at = 0.0
        self._lay_out(dropped, ended=True)

    # -- plots -----------------------------------------------------------------------------

    def _draw_angles(self, batch: Batch, palette: dict[str, entities.Color]) -> None:
        rec, clock = self._rec, self._clock
        measured = batch.columns.get(("/joint_states", "position"), ())
        commanded = batch.columns.get(("/joint_commands", "position"), ())
        self._measured.write(rec, clock, measured, palette)
        self._commanded.write(rec, clock, commanded)
        window = self._window.tracks("/joint_states"), self._window.tracks("/joint_commands")
        new = self._fresh.tracks("error", window[0])
        self._errors.write(rec, clock, quantities.tracking_errors(new, window[1]), palette)
        self._choose_places(window[1] or window[0])
        if self._places is not None:
            self._draw_places(self._places, measured, commanded, palette)

    def _draw_places(
        self,
        places: entities.Places,
        measured: tuple[Track, ...],
        commanded: tuple[Track, ...],
        palette: dict[str, entities.Color],
    ) -> None:
        """Head, middle and tail once more, for a plot that can be read at a glance."""
        for kind, tracks, colors in (
            ("measured", measured, palette),
            ("commanded", commanded, None),
        ):
            plot = self._place_plots.setdefault(
                (kind, places.names),
                LivePlot(
                    f"{joints.PLACES}/{kind}",
                    degrees=True,
                    component=entities.SCALARS,
                    titles=joints.places_titles(places, kind),
                    width=joints.PLACES_WIDTHS[kind],
                ),
            )
            own = [track for track in tracks if track.name in places.names]
            plot.write(self._rec, self._clock, own, colors)

    def _choose_places(self, moving: tuple[Track, ...]) -> None:
        """Head, middle and tail of the plane that moves, once it is clear which does."""
        now = time.monotonic()
        if self._places is not None and now < self._places_at:
            return
        self._places_at = now + _PLACES_EVERY_S
        found = joints.head_middle_tail(self._log.robot, moving)
        if found is None or found == self._places:
            return
        if self._places is not None and self._places.plane is not found.plane:
            swing = {track.name: float(np.nanstd(track.values)) for track in moving}
            before = max(swing.get(name, 0.0) for name in self._places.names)
            if max(swing.get(name, 0.0) for name in found.names) < _CLEARER * before + 1e-3:
                return
        self._places = found

    def _draw_power(self, palette: dict[str, entities.Color]) -> None:
        columns = self._window.columns
        mechanical = quantities.mechanical_power(columns)
        electrical = quantities.electrical_power(columns)
        for kind, tracks in (("electrical", electrical), ("mechanical", mechanical)):
            whole = quantities.total(tracks)
            if whole is None:
                continue
            upto_ns = self._window.ready_ns([tracks])
            for part in self._fresh.tracks(kind, [whole], upto_ns):
                power.log_sum(self._rec, self._clock, kind, part)
                self._has_power = True
        upto_ns = self._window.ready_ns([mechanical])
        self._joint_power.write(
            self._rec, self._clock, self._fresh.tracks("power", mechanical, upto_ns), palette
        )

    def _draw_signals(self, batch: Batch, palette: dict[str, entities.Color]) -> None:
        for (topic, field), tracks in batch.columns.items():
            if topic in DRAWN or field != "position":
                continue
            names = [track.name for track in self._window.tracks(topic)]
            self._of_joints[topic] = bool(set(names) & set(palette))
            colors = palette if self._of_joints[topic] else joints.joint_palette(names)
            plot = self._signals.setdefault(topic, LivePlot(topic_entity(SIGNALS, topic)))
            plot.write(self._rec, self._clock, tracks, colors)

    def _draw_words(self, batch: Batch) -> None:
        turns: list[tuple[int, str]] = []
        for t_ns, mode in batch.modes:
            if t_ns > self._mode_ns:  # what holds is told again and again
                if mode != self._mode:
                    turns.append((t_ns, mode))
                self._mode, self._mode_ns = mode, t_ns
        self._modes += len(turns)
        gait.log_states(self._rec, self._clock, turns)
        gait.log_lines(self._rec, self._clock, batch.events)
        self._has_events |= bool(batch.events)

    # -- the body --------------------------------------------------------------------------

    def _draw_body(self, palette: dict[str, entities.Color]) -> None:
        robot, positions = self._log.robot, self._window.tracks("/joint_states")
        if robot is None or not positions:
            return
        head = self._window.head or still_head(positions[0].t_ns)
        commands = self._window.tracks("/joint_commands")
        drive = quantities.mechanical_power(self._window.columns)
        upto_ns = self._window.ready_ns([positions, drive], head.t_ns)
        fresh = self._fresh.rows("body", head.t_ns, upto_ns)

        def motion_of(rows: IntArray) -> Motion:
            rows = rows[(rows >= fresh.start) & (rows < fresh.stop)]
            place = HeadPath(
                head.t_ns[rows], head.position[rows], head.quaternion[rows], head.tracked
            )
            return assemble(robot, place, positions=positions, commands=commands, power=drive)

        chosen = self._slots(head.t_ns, BODY_RATE_HZ)
        motion = motion_of(chosen)
        ghost = motion_of(chosen[self._slots(head.t_ns[chosen], SPARSE_RATE_HZ)])
        if not motion.t_ns.size:
            return
        if self._start is None:
            self._start = start_of(
                HeadPath(motion.t_ns, motion.head_position, motion.head_quaternion, head.tracked)
            )
            self._rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._scale(drive)
        body.log_body(self._rec, self._clock, motion, limit_w=self._limit_w)
        sparse = np.flatnonzero(np.isin(motion.t_ns, ghost.t_ns))
        body.log_ghost(self._rec, self._clock, motion, sparse)
        self._draw_ranges(ghost)
        if self._places is not None:
            markers.log_markers(self._rec, self._clock, motion, self._places, palette, named=sparse)
        if head.tracked:
            self._draw_trail(motion)

    def _slots(self, t_ns: IntArray, rate_hz: float) -> IntArray:
        """At most so many of the rows a second; :func:`~.replay.samples.sampling.decimate` chooses.

        The slots start with the first row of all, so that it doesn't matter where a batch ends.
        """
        if self._origin_ns is None and t_ns.size:
            self._origin_ns = int(t_ns[0])
        period = round(1e9 / rate_hz)
        slot = (t_ns - (self._origin_ns or 0) + period // 4) // period
        return np.flatnonzero(np.diff(slot, prepend=slot[:1] - 1)).astype(np.int64)

    def _scale(self, drive: tuple[Track, ...]) -> None:
        """Let the colours' full power grow with what was seen, in steps of 1, 2, 5."""
        if not drive:
            return
        seen = power_limit(np.concatenate([track.values for track in drive]))
        if self._limit_w is None or seen > self._limit_w:
            decade = 10.0 ** np.floor(np.log10(seen) + 1e-9)
            self._limit_w = float(
                decade * next(s for s in (1, 2, 5, 10) if seen <= s * decade * (1 + 1e-9))
            )

    def _draw_ranges(self, motion: Motion) -> None:
        known = self._window.ranges
        sensors = tuple(
            sensor for sensor in ranges.range_sensors(motion.robot) if sensor.topic in known
        )
        if not sensors:
            return
        chosen = np.arange(motion.t_ns.size)
        reading = np.stack([hold(*known[sensor.topic], motion.t_ns) for sensor in sensors], axis=1)
        ranges.log_rays(self._rec, self._clock, motion, chosen, sensors=sensors, reading=reading)

    def _draw_trail(self, motion: Motion) -> None:
        """The head's path from the last point that was drawn, ten points a second."""
        for t_ns, position in zip(motion.t_ns.tolist(), motion.head_position, strict=True):
            last = self._trail_end
            if last is not None and t_ns - last[0] < _TAIL_NS:
                continue
            self._trail_end = (t_ns, position)
            if last is not None:
                piece = HeadPath(
                    np.array([last[0], t_ns]),
                    np.stack([last[1], position]),
                    np.tile([0.0, 0.0, 0.0, 1.0], (2, 1)),
                    tracked=True,
                )
                trail.log_trail(self._rec, self._clock, piece)

    # -- layout ----------------------------------------------------------------------------

    def _lay_out(self, dropped: int, *, ended: bool = False) -> None:
        """Send the layout when there is something new to lay out, and the facts."""
        content, now = self.content, time.monotonic()
        if now >= self._facts_at:
            self._facts_at = now + _FACTS_EVERY_S
            log_facts(self._rec, self._facts(content, dropped, ended=ended))
        shape = _shape(content)
        if now < self._layout_at or shape == self._laid_out:
            return
        self._layout_at = now + _LAYOUT_EVERY_S
        self._laid_out = shape
        self._rec.send_blueprint(build_blueprint(content))

    def _facts(self, content: Content, dropped: int, *, ended: bool) -> str:
        """The session in words, as in :mod:`.replay.draw.facts`."""
        robot = content.robot
        start = datetime.fromtimestamp(self._clock.start_ns // 1_000_000_000, UTC)
        facts = [
            code(self._session_id),
            "no robot description"
            if robot is None
            else f"{robot.name}, {len(robot.joints)} joints",
            f"since {start:%Y-%m-%d %H:%M:%S} UTC",
        ]
        notes = list(self._log.notes)
        if robot is not None and self._window.head is None:
            notes.append("no /odom: the head is held at the origin")
        if dropped:
            notes.append(f"{dropped} messages were not shown here; what is recorded is not touched")
        parts = [f"**{'Recorded.' if ended else 'Recording.'}**", " · ".join(facts)]
        if notes:
            parts.append("\n".join(f"- {escaped(note)}" for note in notes))
        legend = f"{body_title(replace(content, live=False))}. Grey is commanded."
        if content.charts:
            legend += " Bars are the last whole cycle of the gait."
        parts.append(legend)
        return "\n\n".join(parts) + "\n"


def _shape(content: Content) -> tuple[object, ...]:
    """What the layout depends on."""
    return (
        content.robot is None,
        content.start is None,
        content.power_limit_w is None,
        content.places,
        content.commanded,
        content.measured,
        content.errors,
        content.has_power,
        content.joint_power,
        content.modes,
        content.has_events,
        content.signals,
        content.charts,
        content.cycles,
    )
