"""What is drawn of a session, piece by piece: the same for a file and for a viewer that runs.

The caller decides the order: a file is written when everything is known, a viewer gets the
beginning first. :attr:`RerunDrawing.content` is the content drawn so far.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import rerun as rr

from undulog.analysis.common.formats import utc
from undulog.analysis.parts.gait.result import GaitFacts, GroupFacts
from undulog.analysis.results.analysis import Analysis
from undulog.capture import SessionView
from undulog.capture.common.console import plain
from undulog.capture.common.errors import DataError
from undulog.capture.robot.kinematics import rotation_from_quaternion
from undulog.capture.robot.model import Robot

from ..samples import content as entities
from ..samples.content import Content, InitialPose, Layer, Named
from ..samples.quantities import GAIT, Survey, quantities, survey
from ..samples.timeline import ENSEMBLE_CYCLE, DrawnSpan, SpanSamples, TimeColumns
from ..samples.tracks import Track, drawn_topics, read_columns
from . import lines
from .body import Look, body_title
from .heat_maps import heat_maps, log_maps
from .mean_cycle import Averaged, log_mean_cycle
from .motion import BODY_RATE_HZ, HeadPath, read_head
from .plots import Plots, log_others, log_words
from .stage import Scene
from .steps import charts, cycle_tables, log_charts, log_current, log_cycles

if TYPE_CHECKING:
    import rerun as rr


FACTS = "/session"

_MARKUP = re.compile(r"([\\`*_{}\[\]<>()#+!|~&$])")

_WHOLE = DrawnSpan()


def escaped(text: str) -> str:
    """Escape text with names from a log for Markdown.

    Returns:
        One line of Markdown that shows it and marks nothing up.
    """
    return _MARKUP.sub(r"\\\1", plain(text))


def code(text: str) -> str:
    """Return a name from a log as a code span of Markdown, valid in tables too.

    Returns:
        A code span of one line; the text itself where it has a backtick.
    """
    return escaped(text) if "`" in text else f"`{plain(text)}`".replace("|", r"\|")


def markdown(
    session: SessionView,
    analysis: Analysis | None,
    *,
    notes: Sequence[str],
    colors: str,
    content: Content,
    named: Sequence[Named] = (),
    has_cycles: bool,
    awaited: bool = False,
) -> str:
    """Return the text that is shown beside the picture, as Markdown.

    Args:
        analysis: Its analysis, or None where there is none.
        notes: What is missing or was assumed, a sentence each.
        colors: What the body's colours mean.
        has_cycles: Whether there is a timeline of gait cycles.
        awaited: Whether its analysis is still to come.
    """
    verdict = session.metadata.get("undulog.health", {}).get("verdict")
    recorded = session.metadata.get("undulog", {}).get("undulog")
    facts = (
        code(session.session_id),
        _robot(session),
        f"{session.duration_s:.1f} s",
        utc(session.start_ns),
        *_gait(analysis),
        *([f"verdict {escaped(verdict)}"] if verdict else []),
        *([f"recorded by undulog {escaped(recorded)}"] if recorded else []),
    )
    awaited_text = "Being analysed: the answer comes in a moment." if awaited else "Not analysed."
    joints = ", ".join(f"{escaped(module.joint)} ({escaped(module.why)})" for module in named)
    return document(
        [
            f"**{escaped(awaited_text if analysis is None else analysis.answer.sentence)}**",
            f"**Named, pink in the pictures:** {joints}" if named else "",
            " · ".join(facts),
            listed([*notes, *(() if analysis is None else analysis.warnings)]),
            _legend(colors, content, has_cycles=has_cycles),
        ]
    )


def document(paragraphs: Sequence[str]) -> str:
    """Markdown of those paragraphs that aren't empty."""
    return "\n\n".join(filter(None, paragraphs)) + "\n"


def listed(notes: Sequence[str]) -> str:
    """Notes as a list in Markdown, each once."""
    return "\n".join(f"- {escaped(note)}" for note in dict.fromkeys(notes))


def _legend(colors: str, content: Content, *, has_cycles: bool) -> str:
    """What lines, bars and timelines mean."""
    words = [f"{colors}."] if content.start is not None else []
    if content.commanded:
        words.append("Grey is commanded.")
    if content.charts:
        words.append(
            "Coloured bars: the analysed stretch, a whisker to the far end of the 95 % interval."
        )
    if content.charts and content.cycles:
        words.append("White bars: the cycle at the cursor; energies are of one cycle.")
    if has_cycles:
        words.append("On `gait_cycle` one second is one cycle of the gait.")
    if content.mean is not None:
        words.append(
            f"`{ENSEMBLE_CYCLE}` plays the mean cycle by degrees of phase (tab *Mean cycle*)."
        )
    return " ".join(words)


def log_facts(rec: rr.RecordingStream, text: str, entity: str = FACTS) -> None:
    """Write the session's facts as Markdown."""
    import rerun as rr

    rec.log(entity, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN), static=True)


def _robot(session: SessionView) -> str:
    if session.robot is None:
        return "no robot description"
    count = len(session.robot.joints)
    return f"{session.robot.name}, {count} joint{'s' if count != 1 else ''}"


def _gait(analysis: Analysis | None) -> list[str]:
    if analysis is None or analysis.gait.frequency_hz.value is None:
        return []
    groups = analysis.gait.groups
    if len(groups) > 1:
        return [_wave(group, f" ({len(group.joints)} joints)") for group in groups]
    return [_wave(analysis.gait)]


def _wave(gait: GaitFacts | GroupFacts, joints: str = "") -> str:
    """Frequency, number of joints and wave of one group, or of all joints."""
    parts = [f"{gait.frequency_hz.value:.3f} Hz{joints}"]
    if gait.wave is not None:
        parts.append(f"wave {gait.wave}")
    lags = gait.lag_per_joint_rad.items()
    parts += [f"{math.degrees(lag):.1f}° a joint ({plane})" for plane, lag in lags]
    return ", ".join(parts)


@dataclass
class Sources:
    """A session with its survey, as the input of a drawing.

    Attributes:
        warnings: What is missing or was assumed, a sentence each; grows while it is drawn.
    """

    session: SessionView
    survey: Survey
    warnings: list[str]

    @classmethod
    def of(cls, session: SessionView, surveyed: Survey | None = None) -> Sources:
        """Survey a session.

        Args:
            surveyed: What it holds, where that is known; None to go through it.

        Raises:
            DataError: If the session holds nothing that can be drawn.
        """
        if not any(channel.count for channel in session.channels.values()):
            raise DataError(f"{session.path}: the session holds no messages; nothing can be drawn")
        surveyed = survey(session, BODY_RATE_HZ) if surveyed is None else surveyed
        missing: list[str] = []
        if session.robot is None:
            missing.append("no robot description in the session: the body can't be drawn")
        if entities.MEASURED not in surveyed.samples:
            missing.append("no measured joint angles on /joint_states")
        if left_out := drawn_topics(session)[1]:
            missing.append(f"{left_out} more joint topics are not shown")
        return cls(session, surveyed, missing)

    @property
    def measured(self) -> tuple[Track, ...]:
        """Some samples of each measured angle [rad]."""
        return self.survey.samples.get(entities.MEASURED, ())

    @property
    def commanded(self) -> tuple[Track, ...]:
        """Some samples of each commanded angle [rad]."""
        return self.survey.samples.get(entities.COMMANDED, ())


def clock_of(session: SessionView) -> TimeColumns:
    """Return the session's timelines.

    Returns:
        Its clock, with the phase of its gait where one was logged.
    """
    phases: tuple[Track, ...] = ()
    if GAIT in session.channels:
        phases = read_columns(session, {GAIT: ["position"]}).get((GAIT, "position"), ())
    return TimeColumns(session.start_ns, lines.rhythm_of(phases))


class RerunDrawing:
    """A session on its way into a recording stream."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        clock: TimeColumns,
        sources: Sources,
        named: Sequence[Named] = (),
        *,
        span: DrawnSpan = _WHOLE,
        averaged: Averaged | None = None,
    ) -> None:
        """Write styles and static entities.

        Args:
            named: Modules that tests name, to be marked.
            averaged: Keeps what the mean cycle needs of all stretches, where the analysis is known
                before; else it is read again.
            span: The part of the session that is at hand: the body's path is read and drawn no
                further before :meth:`widen`.
        """
        self._rec, self._clock, self._sources = rec, clock, sources
        self._named = [module.joint for module in named]
        self._averaged = averaged
        robot = sources.session.robot
        moving = sources.measured or sources.commanded
        self._palette = palette_of(robot, [track.name for track in moving])
        self._places = lines.head_middle_tail(robot, sources.commanded or sources.measured)
        surveyed = sources.survey
        self._plots = Plots(
            rec, clock, surveyed.parts, self._places, self._palette, samples=surveyed.samples
        )
        self._head, self._scene = self._open_scene(span)
        self.content = self._written()
        """What is drawn by now."""

    @property
    def limit_w(self) -> float | None:
        """Power at which a segment's colour is full [W]; None where no body is drawn."""
        return None if self._head is None else self._sources.survey.power_limit_w

    def write(self, stretch: SpanSamples) -> None:
        """Draw a stretch."""
        span = stretch.span
        if self._averaged is not None:
            self._averaged.keep(stretch)
        self._plots.write(
            quantities(stretch.columns), lambda _, t_ns: span.rows(t_ns), span.known_ns
        )
        if self._scene is not None:
            self._scene.write(stretch)

    def widen(self, surveyed: Survey, span: DrawnSpan) -> None:
        """Continue with a further part of a session whose beginning is drawn.

        Args:
            span: The part of the head's trail that isn't drawn yet.
        """
        self._sources = replace(self._sources, survey=surveyed)
        self._head, self._scene = self._open_scene(span)

    def write_words(self) -> None:
        """Write modes, events and remarks."""
        rec, clock, session = self._rec, self._clock, self._sources.session
        warnings = self._sources.warnings
        modes = lines.log_mode(rec, clock, session, warnings)
        events = lines.log_events(rec, clock, session, warnings)
        words = log_words(rec, clock, session)
        self.content = replace(self.content, modes=modes, has_events=events or words)

    def write_others(self) -> None:
        """Write the topics of a foreign bag that aren't joints."""
        others = log_others(self._rec, self._clock, self._sources.session, self._sources.warnings)
        self.content = replace(self.content, signals=(*self.content.signals, *others))

    def write_response(self, layer: Layer) -> None:
        """Write each joint's response: bars and maps.

        Args:
            layer: What is known of the session.
        """
        analysis = layer.analysis
        if analysis is None:
            return
        bar_charts = charts(analysis)
        tables = cycle_tables(analysis, layer.steady)
        maps = heat_maps(analysis, tables, tuple(self._palette))
        log_charts(self._rec, bar_charts, self._palette, self._named)
        log_current(self._rec, self._clock, bar_charts, tables)
        log_maps(self._rec, self._clock, maps, self._named)
        self.content = replace(self.content, charts=bar_charts, maps=maps)

    def write_cycles(self, layer: Layer) -> None:
        """Write values by cycle, and the mean of all cycles.

        Args:
            layer: What is known of the session.
        """
        analysis, sources = layer.analysis, self._sources
        tables = cycle_tables(analysis, layer.steady) if analysis is not None else ()
        cycles = log_cycles(self._rec, self._clock, tables, self._palette)
        if self._averaged is None:
            averaged = Averaged(self._clock, analysis).read(sources.session, sources.survey.topics)
        else:
            averaged = self._averaged.kept
        mean = log_mean_cycle(
            self._rec,
            self._clock,
            averaged,
            self._look(self.limit_w),
            analysis=analysis,
            warnings=sources.warnings,
        )
        self.content = replace(self.content, cycles=cycles, mean=mean)

    def write_facts(
        self, session: SessionView, layer: Layer, content: Content, *, awaited: bool = False
    ) -> list[str]:
        """Write the session in words; what was written before is replaced.

        Args:
            layer: What is known of it.
            content: What the recording holds, or will.
            awaited: Whether its numbers are still to come.

        Returns:
            What is missing or was assumed by now, a sentence each.
        """
        notes = list(dict.fromkeys([*layer.notes, *self._sources.warnings, *session.warnings]))
        text = markdown(
            session,
            layer.analysis,
            notes=notes,
            colors=body_title(content),
            content=content,
            named=layer.named,
            has_cycles=self._clock.rhythm is not None,
            awaited=awaited,
        )
        log_facts(self._rec, text)
        return notes

    def _written(self) -> Content:
        """Return the content that every window of samples has."""
        session = self._sources.session
        units = {
            topic: channel.metadata.get("unit", "rad")
            for topic, channel in session.channels.items()
        }
        return replace(
            self._plots.content(session.robot, units),
            start=None if self._head is None else start_of(self._head),
            power_limit_w=self.limit_w,
        )

    def _look(self, limit_w: float | None) -> Look:
        robot = self._sources.session.robot
        return Look(robot, self._places, self._palette, limit_w, self._named)

    def _open_scene(self, span: DrawnSpan) -> tuple[HeadPath | None, Scene | None]:
        """The 3D scene, where there is a robot whose joints were measured."""
        sources = self._sources
        robot, measured = sources.session.robot, sources.measured
        if robot is None or not measured:
            return None, None
        times = Track(measured[0].name, sources.survey.drawing_ns, np.zeros(0))
        session = sources.session.view(stop_ns=span.known_ns)
        head = read_head(session, robot, [times], sources.warnings)
        names = {track.name for track in measured}
        if missing := [name for name in robot.joint_names if name not in names]:
            sources.warnings.append(
                f"no angles of {', '.join(missing)}: the body is drawn up to the first of these"
            )
        scene = Scene(
            self._rec,
            self._clock,
            session,
            robot,
            head,
            look=self._look(sources.survey.power_limit_w),
            warnings=sources.warnings,
            span=span,
        )
        return head, scene


def palette_of(robot: Robot | None, names: Sequence[str]) -> dict[str, entities.Color]:
    """Return colours of the robot's joints, or of those in the log if there is no robot.

    Args:
        robot: The robot, or None.
        names: Joints in the log, head to tail.

    Returns:
        Colour by joint name; joints that the robot doesn't have are grey.
    """
    if robot is None:
        return lines.joint_palette(names)
    return dict.fromkeys(names, entities.GREY) | lines.joint_palette(robot.joint_names)


def start_of(head: HeadPath) -> InitialPose | None:
    """Return the initial pose of the robot, for the camera.

    Args:
        head: The head's path.

    Returns:
        Its first known pose, or None where none is known.
    """
    placed = np.flatnonzero(np.isfinite(head.position).all(axis=1))
    if not placed.size:
        return None
    x, y, z = head.position[placed[0]].tolist()
    forward = rotation_from_quaternion(head.quaternion[placed[0]])[:, 0]
    heading = float(np.arctan2(forward[1], forward[0]))
    return InitialPose((x, y, z), heading if np.isfinite(heading) else 0.0)
