"""The plots of a session, written stretch by stretch.

What a bag of another make has beside joints: numbers as plots, words as events.

A topic of any type is plotted field by field, as logged, as long as its first message holds few
numbers; images, clouds and transforms are left out, and a note names them. Sessions of undulog have
views of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, cast

import numpy as np
import rerun as rr

from undulog.capture import SessionView
from undulog.capture.common.arrays import IntArray
from undulog.capture.common.errors import DataError
from undulog.capture.log.columns.topics import Channel
from undulog.capture.robot.model import Robot

from ..samples.content import (
    COMMANDED,
    ERROR,
    MEASURED,
    MECHANICAL,
    SCALARS,
    TOTAL,
    BodyPlaces,
    Color,
    Content,
    PlottedSeries,
    PlottedSignal,
    signal_title,
)
from ..samples.quantities import SIGNALS, topic_entity
from ..samples.timeline import TimeColumns, stretch_length_ns
from ..samples.tracks import JOINT_STATE, Track, join_tracks, mark_gaps, ordered, plot_step
from .lines import (
    DEGREES,
    EVENTS,
    INFO,
    PLACES,
    changes,
    joint_palette,
    log_look,
    log_rows,
    log_texts,
    log_total_look,
    part_entities,
    places_look,
)

OTHERS = "/others"

MOST_NUMBERS = 128
"""In a message; one with more of them is a picture, not a few lines."""
MOST_LINES = 12

_WORDS = "std_msgs/msg/String"
_SHOWN_ELSEWHERE = {"/gait/mode", "/rosout", "/robot_description"}
_TAKE_TURNS = {"tf2_msgs/msg/TFMessage"}  # types whose messages are each about something else
_NOT_PLOTTED = ("covariance", "stamp", "layout", "header")

_ANGLES = (COMMANDED, MEASURED, ERROR)


Rows = Callable[[str, IntArray], slice]
"""Of an entity and the times of its samples: which of them are drawn."""


def is_foreign(session: SessionView) -> bool:
    """Return whether a session was neither recorded nor imported by undulog.

    Returns:
        True where it doesn't carry undulog's metadata.
    """
    return "undulog" not in session.metadata


def log_others(
    rec: rr.RecordingStream, clock: TimeColumns, session: SessionView, warnings: list[str]
) -> tuple[PlottedSignal, ...]:
    """Plot the numbers of every other topic of a foreign bag.

    Args:
        warnings: Grows by a sentence that names the topics left out.

    Returns:
        A signal a topic; none for a session of undulog's own.
    """
    signals: list[PlottedSignal] = []
    left_out: list[str] = []
    for topic, channel in _others(session):
        if channel.type_name == _WORDS:
            continue
        lines = _lines(session, topic) if _is_plotted(session, channel) else ()
        if not lines:
            left_out.append(f"{topic} ({channel.type_name or channel.encoding})")
            continue
        entity = topic_entity(OTHERS, topic)
        log_look(rec, entity, lines, joint_palette(lines))
        rec.flush()  # else what comes first in the file is chance
        for table in _tables(session, topic):
            values = table.reindex(columns=list(lines)).to_numpy(np.float64)
            t_ns = table.index.to_numpy(dtype=np.int64)
            log_rows(rec, clock, entity, *mark_gaps(*ordered(t_ns, values)))
        signals.append(
            PlottedSignal(topic.lstrip("/"), (PlottedSeries(entity, lines),), of_joints=False)
        )
    if left_out:
        warnings.append(f"not shown: {', '.join(left_out)}")
    return tuple(signals)


def log_words(rec: rr.RecordingStream, clock: TimeColumns, session: SessionView) -> bool:
    """Write String topics of a foreign bag as events, each time that their value changes."""
    words: list[tuple[int, str]] = []
    for topic, channel in _others(session):
        if channel.type_name == _WORDS and channel.is_ros2:
            messages = [
                (t_ns, str(message.data))
                for t_ns, message in session.messages(topic)
                if hasattr(message, "data")  # a log's own definition of the type may lack it
            ]
            turns = changes([word for _, word in messages])
            words += [(messages[i][0], f"{topic}: {messages[i][1]}") for i in turns]
    words.sort()
    log_texts(rec, clock, f"{EVENTS}/said", words, [INFO] * len(words))
    return bool(words)


def _others(session: SessionView) -> Iterator[tuple[str, Channel]]:
    if not is_foreign(session):
        return
    for topic, channel in session.channels.items():
        if channel.count and channel.type_name != JOINT_STATE and topic not in _SHOWN_ELSEWHERE:
            yield topic, channel


def _is_plotted(session: SessionView, channel: Channel) -> bool:
    if not channel.is_ros2 or channel.type_name in _TAKE_TURNS:
        return False
    try:
        _, message = next(session.messages(channel.topic))
    except (DataError, StopIteration):
        return False
    return _count(message) <= MOST_NUMBERS


def _count(value: Any) -> int:
    """Numbers in a message, without looking into long arrays one by one."""
    if isinstance(value, (str, bool)) or value is None:
        return 0
    if isinstance(value, (int, float)):
        return 1
    if isinstance(value, (bytes, bytearray, memoryview, np.ndarray)):
        return len(cast("bytes", value))
    if isinstance(value, (list, tuple)):
        many = cast("list[Any]", value)
        return len(many) if len(many) > MOST_NUMBERS else sum(map(_count, many))
    return sum(_count(getattr(value, name)) for name in getattr(value, "__slots__", ()))


def _lines(session: SessionView, topic: str) -> tuple[str, ...]:
    """Fields to plot: those that vary first, if they are many."""
    for table in _tables(session, topic):
        numbers = table.select_dtypes("number")
        columns = map(str, numbers.columns)
        names = [column for column in columns if not any(word in column for word in _NOT_PLOTTED)]
        moving = {name for name in names if numbers[name].nunique() > 1}
        chosen = sorted(names, key=lambda name: name not in moving)[:MOST_LINES]
        return tuple(name for name in names if name in chosen)
    return ()


def _tables(session: SessionView, topic: str) -> Iterator[Any]:
    """The topic's tables, stretch by stretch, those with rows."""
    length_ns = stretch_length_ns(session)
    for start_ns in range(session.start_ns, session.end_ns + 1, length_ns):
        table = session.table(topic, start_ns=start_ns, stop_ns=start_ns + length_ns)
        session.forget()
        if len(table):
            yield table


def every_row(_entity: str, t_ns: IntArray) -> slice:
    """Draw all samples."""
    return slice(0, t_ns.size)


class Plot:
    """One quantity of all joints."""

    def __init__(
        self,
        entity: str,
        parts: Sequence[tuple[str, ...]],
        samples: Sequence[Track] = (),
        *,
        degrees: bool = False,
        component: str = SCALARS,
    ) -> None:
        """Prepare it.

        Args:
            entity: E.g. ``/joints/measured``.
            parts: Names of the lines, those in one part that are drawn at common times.
            samples: Some samples of each line, by which it is rounded; without them it isn't.
            degrees: Whether the values are angles [rad], to be plotted in degrees.
        """
        paths = part_entities(entity, parts)
        self.series = tuple(
            PlottedSeries(path, part, component) for path, part in zip(paths, parts, strict=True)
        )
        """What is written."""
        self._degrees = degrees
        self._steps = {
            track.name: plot_step(np.rad2deg(track.values) if degrees else track.values)
            for track in samples
        }

    def style(
        self, rec: rr.RecordingStream, palette: Mapping[str, Color] | None, **look: Any
    ) -> None:
        """Write the style of its lines, as :func:`~.replay.draw.lines.log_look` takes it."""
        for series in self.series:
            log_look(rec, series.entity, series.names, palette, **look)

    def write(
        self,
        rec: rr.RecordingStream,
        clock: TimeColumns,
        tracks: Sequence[Track],
        rows: Rows = every_row,
        known_ns: int | None = None,
    ) -> None:
        """Write samples.

        Args:
            tracks: The samples, with those just before and after them.
            rows: What of them is drawn.
            known_ns: Until when samples are at hand [ns]; None where nothing comes after them.
        """
        by_name = {track.name: track for track in tracks}
        for series in self.series:
            members = [by_name[name] for name in series.names if name in by_name]
            if not members:
                continue
            table = join_tracks(members)
            values = np.full((table.t_ns.size, len(series.names)), np.nan)
            values[:, [series.names.index(name) for name in table.names]] = table.values
            t_ns, values = mark_gaps(table.t_ns, values, known_ns)
            drawn = rows(series.entity, t_ns)
            log_rows(
                rec,
                clock,
                series.entity,
                t_ns[drawn],
                values[drawn],
                degrees=self._degrees,
                component=series.component,
                steps=np.array([self._steps.get(name, 0.0) for name in series.names]),
            )


class Plots:
    """All plots of a session."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clock: TimeColumns,
        parts: Mapping[str, Sequence[tuple[str, ...]]],
        places: BodyPlaces | None,
        palette: Mapping[str, Color],
        *,
        samples: Mapping[str, Sequence[Track]] = MappingProxyType({}),
    ) -> None:
        """Write the style of the lines.

        Args:
            parts: Entity to the names of its lines, as :class:`Plot` takes them.
            places: Joints that stand for the body, or None.
            palette: Colour by joint name.
            samples: Entity to some samples of each line, by which it is rounded.
        """
        self._rec, self._clock, self._palette, self._chosen = rec, clock, palette, places
        self._plots = {
            entity: Plot(
                entity,
                part,
                samples.get(entity, ()),
                degrees=entity in _ANGLES,
                component=DEGREES if entity in _ANGLES else SCALARS,
            )
            for entity, part in parts.items()
        }
        self._places: dict[str, Plot] = {}
        for entity, plot in self._plots.items():
            if entity.startswith(f"{TOTAL}/"):
                log_total_look(rec, entity.removeprefix(f"{TOTAL}/"))
                continue
            plot.style(rec, None if entity == COMMANDED else _colors(entity, plot, palette))
        if places is not None:
            for source, kind in ((COMMANDED, "commanded"), (MEASURED, "measured")):
                self._add_places(parts.get(source, ()), places, samples, source, kind)

    def series(self, entity: str) -> tuple[PlottedSeries, ...]:
        """Return the series that are written of a quantity.

        Args:
            entity: E.g. ``/joints/measured``.

        Returns:
            One series where all joints are drawn at common times; none where there is none.
        """
        return self._plots[entity].series if entity in self._plots else ()

    def content(self, robot: Robot | None, units: Mapping[str, str]) -> Content:
        """Return what the plots hold of a recording.

        Args:
            units: Topic to the unit of its positions, of all JointState topics.
        """
        return Content(
            robot=robot,
            places=self._chosen,
            commanded=self.series(COMMANDED),
            measured=self.series(MEASURED),
            errors=self.series(ERROR),
            has_power=any(entity.startswith(TOTAL) for entity in self._plots),
            joint_power=self.series(MECHANICAL),
            signals=self._signals(units),
        )

    def write(
        self, tracks: Mapping[str, Sequence[Track]], rows: Rows, known_ns: int | None = None
    ) -> None:
        """Write samples.

        Args:
            tracks: Entity to its lines, as :func:`~.replay.samples.quantities.quantities` has them.
            rows: What of them is drawn.
            known_ns: As :meth:`Plot.write` takes it.
        """
        for entity, plot in self._plots.items():
            if entity in tracks:
                plot.write(self._rec, self._clock, tracks[entity], rows, known_ns)
        for source, plot in self._places.items():
            plot.write(self._rec, self._clock, tracks.get(source, ()), rows, known_ns)

    def _signals(self, units: Mapping[str, str]) -> tuple[PlottedSignal, ...]:
        """Every other JointState topic as it is: currents, voltages, temperatures, foreign ones."""
        signals: list[PlottedSignal] = []
        topics = {topic_entity(SIGNALS, topic): topic for topic in units}
        for entity, plot in self._plots.items():
            if entity.startswith(f"{SIGNALS}/"):
                topic = topics[entity]
                of_joints = any(
                    name in self._palette for series in plot.series for name in series.names
                )
                signals.append(
                    PlottedSignal(signal_title(topic, units[topic]), plot.series, of_joints)
                )
        return tuple(signals)

    def _add_places(
        self,
        parts: Sequence[tuple[str, ...]],
        places: BodyPlaces,
        samples: Mapping[str, Sequence[Track]],
        source: str,
        kind: str,
    ) -> None:
        """Add a plot of head, middle and tail alone, which can be read at a glance."""
        chosen = [tuple(name for name in part if name in places.names) for part in parts]
        tracks = [track for track in samples.get(source, ()) if track.name in places.names]
        plot = Plot(f"{PLACES}/{kind}", [part for part in chosen if part], tracks, degrees=True)
        self._places[source] = plot
        colors = self._palette if kind == "measured" else None
        plot.style(self._rec, colors, **places_look(places, kind))


def _colors(entity: str, plot: Plot, palette: Mapping[str, Color]) -> Mapping[str, Color]:
    """The joints' colours, or colours of its own for a signal that is not of the joints."""
    names = [name for series in plot.series for name in series.names]
    if entity.startswith(f"{SIGNALS}/") and not set(names) & set(palette):
        return joint_palette(names)
    return palette
