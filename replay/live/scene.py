"""Draws a recording while it is made, with the entities, colours and views of its replay.

What is drawn is computed over the last seconds with the replay's own functions: single samples as
soon as they have come, quantities of several samples (the body, power) up to the time at which all
of their inputs have been received.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial

import numpy as np
import rerun as rr

from undulog.capture.common.arrays import FloatArray, IntArray

from ..draw import lines, stage
from ..draw.body import Look, body_title
from ..draw.drawing import code, document, listed, log_facts, palette_of, start_of
from ..draw.motion import HeadPath, assemble, frames_of, still_head
from ..draw.plots import Plots
from ..layout import build_blueprint
from ..samples import content as entities
from ..samples.content import Content, InitialPose
from ..samples.quantities import power_limit, quantities, refined
from ..samples.timeline import TimeColumns
from ..samples.tracks import Columns, Track, hold, ordered, sampled_together
from .cycles import CycleBars, CycleMeter
from .decode import PATIENCE_NS, LiveLog, SampleBatch

_LAYOUT_EVERY_S = 1.0
_FACTS_EVERY_S = 2.0
_PLACES_EVERY_S = 0.2
_CLEARER = 2.0  # another plane's joints are plotted once they swing so many times as far

_KEPT_NS = 2_000_000_000  # length of a window

# Quantities of several samples, and what they are computed from.
_WAITING = {
    entities.MECHANICAL: ("/joint_states", "effort"),
    f"{entities.TOTAL}/mechanical": ("/joint_states", "effort"),
    f"{entities.TOTAL}/electrical": ("/joint_current", "position"),
}


class _Window:
    """Samples of the last seconds.

    Attributes:
        late_ns: Earliest of the newest samples that came after later ones [ns]; None without.
    """

    def __init__(self) -> None:
        """Start empty."""
        self.head: HeadPath | None = None
        self.ranges: dict[str, tuple[IntArray, FloatArray]] = {}
        self.late_ns: int | None = None
        self._tracks: dict[tuple[str, str], dict[str, Track]] = {}
        self._newest_ns = 0

    @property
    def columns(self) -> Columns:
        """All JointState columns."""
        return {key: tuple(tracks.values()) for key, tracks in self._tracks.items()}

    def add(self, batch: SampleBatch) -> None:
        """Take new samples, and forget the oldest."""
        self.late_ns = None
        for key, tracks in batch.columns.items():
            by_name = self._tracks.setdefault(key, {})
            for track in tracks:
                old = by_name.get(track.name)
                if old is not None and track.t_ns[0] <= old.t_ns[-1]:
                    self.late_ns = min(self.late_ns or 1 << 62, int(track.t_ns[0]))
                kept = None if old is None else (old.t_ns, old.values)
                by_name[track.name] = Track(track.name, *_grown(kept, track.t_ns, track.values))
        for topic, (t_ns, values) in batch.ranges.items():
            self.ranges[topic] = _grown(self.ranges.get(topic), t_ns, values)
        if batch.head is not None:
            kept = None if self.head is None else (self.head.t_ns, self.head.pose)
            path = _grown(kept, batch.head.t_ns, batch.head.pose)
            self.head = HeadPath.of(*path, tracked=True)
        ends = [track.t_ns[-1] for tracks in batch.columns.values() for track in tracks]
        self._newest_ns = max([self._newest_ns, *map(int, ends)])

    def ready_ns(self, tracks: Iterable[Track], *others: IntArray) -> int:
        """Return the time up to which a quantity can be computed from all of its inputs.

        Args:
            tracks: What it is computed from.
            others: Times of further inputs [ns].

        Returns:
            The earliest of the inputs' last times, but no more than the patience before the newest
            sample of all [ns].
        """
        ends = [int(t_ns[-1]) for t_ns in (*(track.t_ns for track in tracks), *others) if t_ns.size]
        return max(min(ends, default=0), self._newest_ns - PATIENCE_NS)


class _Fresh:
    """Remembers up to where something has been drawn."""

    def __init__(self) -> None:
        """Nothing has been drawn."""
        self._until_ns: dict[str, int] = {}

    def rows(self, name: str, t_ns: IntArray, *, upto_ns: int | None = None) -> slice:
        """Return which samples are new, and mark them as drawn.

        Args:
            t_ns: Their times [ns], ascending, shape (n,).
            upto_ns: The last time that can be drawn [ns]; None for all.
        """
        start = int(np.searchsorted(t_ns, self._until_ns.get(name, -1), side="right"))
        stop = t_ns.size
        if upto_ns is not None:
            stop = int(np.searchsorted(t_ns, upto_ns, side="right"))
        if stop > start:
            self._until_ns[name] = int(t_ns[stop - 1])
        return slice(start, max(start, stop))

    def back_to(self, t_ns: int) -> None:
        """Draw again what is not before a time [ns]: a sample has come late."""
        self._until_ns = {name: min(until, t_ns - 1) for name, until in self._until_ns.items()}


def _grown(
    old: tuple[IntArray, FloatArray] | None, t_ns: IntArray, values: FloatArray
) -> tuple[IntArray, FloatArray]:
    """Append new samples to those of the last seconds before them."""
    if old is None or t_ns[-1] < old[0][-1] - _KEPT_NS:  # the clock was set back
        return t_ns, values
    first = int(np.searchsorted(old[0], int(old[0][-1]) - _KEPT_NS))  # a gap needs what was before
    return ordered(np.concatenate([old[0][first:], t_ns]), np.concatenate([old[1][first:], values]))


class LiveScene:
    """One recording as it grows."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        log: LiveLog,
        session_id: str,
        epoch_ns: int,
        now_ns: Callable[[], int],
    ) -> None:
        """Draw nothing yet.

        Args:
            log: What is known of the recording.
            session_id: The session's id.
            epoch_ns: Where ``session_time`` starts [Unix ns].
            now_ns: Returns the time [ns, monotonic]: facts and layout are sent now and then.
        """
        self._now_ns = now_ns
        self._rec, self._log, self._session_id = rec, log, session_id
        self._clock = TimeColumns(epoch_ns)
        self._window, self._fresh = _Window(), _Fresh()
        self._parts: dict[str, list[tuple[str, ...]]] = {}
        self._places: entities.BodyPlaces | None = None
        self._palette: dict[str, entities.Color] = {}
        self._plots = Plots(rec, self._clock, {}, None, {})
        self._plotted: tuple[object, ...] = ()
        self._meter, self._bars = CycleMeter(epoch_ns), CycleBars()
        self._start: InitialPose | None = None
        self._origin_ns: int | None = None
        self._limit_w: float | None = None
        self._mode: str | None = None
        self._mode_ns = 0
        self._modes = 0
        self._has_events = False
        self._laid_out: tuple[object, ...] = ()
        self._layout_at = self._facts_at = self._places_at = 0.0

    @property
    def content(self) -> Content:
        """Content that has been drawn so far."""
        return replace(
            self._plots.content(self._log.robot, self._log.units),
            start=self._start,
            power_limit_w=self._limit_w,
            charts=self._bars.charts,
            cycles=self._bars.cycles,
            modes=min(self._modes, 2),  # one or several: more lay out nothing anew
            has_events=self._has_events,
            live=True,
        )

    def draw(self, batch: SampleBatch, dropped: int = 0) -> None:
        """Draw new samples.

        Args:
            dropped: Messages that could not be shown so far.
        """
        self._window.add(batch)
        if self._window.late_ns is not None:
            self._fresh.back_to(self._window.late_ns)
        columns = self._window.columns
        tracks = quantities(columns)
        measured, commanded = (
            tracks.get(entity, ()) for entity in (entities.MEASURED, entities.COMMANDED)
        )
        names = [track.name for track in measured or commanded]
        self._palette = palette_of(self._log.robot, names)
        self._choose_places(commanded or measured)
        self._draw_lines(tracks, columns)
        self._draw_words(batch)
        self._draw_body(measured, columns, tracks.get(entities.MECHANICAL, ()))
        for cycle in self._meter.add(batch, self._log.robot):
            self._bars.take(cycle)
        self._bars.write(self._rec, self._clock, self._palette)
        self._lay_out(dropped)

    def finish(self, dropped: int = 0) -> None:
        """Draw the end of the recording.

        Args:
            dropped: Messages that could not be shown.
        """
        self._bars.write(self._rec, self._clock, self._palette, everything=True)
        self._layout_at = self._facts_at = 0.0
        self._lay_out(dropped, ended=True)

    # -- plots -----------------------------------------------------------------------------

    def _draw_lines(self, tracks: Mapping[str, Sequence[Track]], columns: Columns) -> None:
        """Write what is new of all lines; those that part once stay apart."""
        for entity, group in tracks.items():
            now = [tuple(track.name for track in part) for part in sampled_together(group)]
            self._parts[entity] = refined(self._parts.get(entity, ()), now)
        plotted = dict(self._parts), self._places, self._palette
        if plotted != self._plotted:
            self._plotted = plotted
            self._plots = Plots(self._rec, self._clock, *plotted)
        ready = {
            entity: self._window.ready_ns(columns.get(key, ())) for entity, key in _WAITING.items()
        }

        def rows(path: str, t_ns: IntArray) -> slice:
            upto = [upto_ns for entity, upto_ns in ready.items() if path.startswith(entity)]
            return self._fresh.rows(path, t_ns, upto_ns=min(upto, default=None))

        self._plots.write(tracks, rows)

    def _choose_places(self, moving: tuple[Track, ...]) -> None:
        """Choose head, middle and tail of the plane that moves, once it is clear which does."""
        now = self._now_ns() * 1e-9
        if self._places is not None and now < self._places_at:
            return
        self._places_at = now + _PLACES_EVERY_S
        places = lines.head_middle_tail(self._log.robot, moving)
        if places is None or places == self._places:
            return
        if self._places is not None and self._places.plane is not places.plane:
            swing = {track.name: float(np.nanstd(track.values)) for track in moving}
            before, after = (
                max(swing.get(name, 0.0) for name in choice.names)
                for choice in (self._places, places)
            )
            if after < _CLEARER * before + 1e-3:
                return
        self._places = places

    def _draw_words(self, batch: SampleBatch) -> None:
        turns: list[tuple[int, str]] = []
        for t_ns, mode in batch.modes:
            if t_ns > self._mode_ns:  # the current mode is repeated
                if mode != self._mode:
                    turns.append((t_ns, mode))
                self._mode, self._mode_ns = mode, t_ns
        self._modes += len(turns)
        lines.log_states(self._rec, self._clock, turns)
        lines.log_lines(self._rec, self._clock, batch.events)
        self._has_events |= bool(batch.events)

    # -- the body --------------------------------------------------------------------------

    def _draw_body(
        self, positions: tuple[Track, ...], columns: Columns, drive: tuple[Track, ...]
    ) -> None:
        robot = self._log.robot
        if robot is None or not positions:
            return
        head = self._window.head or still_head(positions[0].t_ns)
        if self._origin_ns is None:
            self._origin_ns = int(head.t_ns[0])
        upto_ns = self._window.ready_ns((*positions, *drive), head.t_ns)
        frames, is_sparse = frames_of(head, None, self._origin_ns)
        rows = self._fresh.rows("body", frames.t_ns, upto_ns=upto_ns)
        if rows.start == rows.stop:
            return
        motion = assemble(robot, frames.at(rows), columns)
        if self._start is None:
            self._start = start_of(motion.head)
            self._rec.log("/world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._scale(drive)
        sparse = np.flatnonzero(is_sparse[rows])
        sensors = stage.range_sensors(robot, self._window.ranges)
        at_ns = motion.t_ns[sparse]
        reading = np.array(
            [hold(*self._window.ranges[sensor.topic], at_ns) for sensor in sensors]
        ).T
        look = Look(robot, self._places, self._palette, self._limit_w)
        stage.log_motion(
            self._rec, self._clock, motion, sparse, look=look, ranges=(sensors, reading)
        )
        if head.tracked:
            part = partial(self._fresh.rows, "trail", upto_ns=upto_ns)
            stage.log_trail(self._rec, self._clock, head, part, self._origin_ns)

    def _scale(self, drive: tuple[Track, ...]) -> None:
        """Increase the colours' full power with the measured power, in steps of 1, 2, 5."""
        if not drive:
            return
        seen = power_limit(np.concatenate([track.values for track in drive]))
        if self._limit_w is None or seen > self._limit_w:
            decade = 10.0 ** np.floor(np.log10(seen) + 1e-9)
            self._limit_w = float(
                decade * next(s for s in (1, 2, 5, 10) if seen <= s * decade * (1 + 1e-9))
            )

    # -- layout ----------------------------------------------------------------------------

    def _lay_out(self, dropped: int, *, ended: bool = False) -> None:
        """Send the layout when there is something new to lay out, and the facts."""
        content, now = self.content, self._now_ns() * 1e-9
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
        """Return the session's facts as text, as in :mod:`.replay.draw.drawing`."""
        robot = content.robot
        start = datetime.fromtimestamp(self._clock.start_ns // 1_000_000_000, UTC)
        made = "no robot description"
        if robot is not None:
            made = f"{robot.name}, {len(robot.joints)} joints"
        facts = [code(self._session_id), made, f"since {start:%Y-%m-%d %H:%M:%S} UTC"]
        notes = list(self._log.notes)
        if robot is not None and self._window.head is None:
            notes.append("no /odom: the head is held at the origin")
        if dropped:
            notes.append(f"{dropped} messages were not shown here; what is recorded is not touched")
        legend = f"{body_title(replace(content, live=False))}. Grey is commanded."
        if content.charts:
            legend += " Bars are the last whole cycle of the gait."
        first = "Recorded." if ended else "Recording."
        return document([f"**{first}**", " · ".join(facts), listed(notes), legend])


def _shape(content: Content) -> tuple[object, ...]:
    """Return the content that determines the layout: whether there is a robot, not which."""
    bare = replace(content, robot=None, start=None, power_limit_w=None)
    return content.robot is None, content.start is None, content.power_limit_w is None, bare
