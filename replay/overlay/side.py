"""One of the sessions that are seen side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from undulog.analysis.compare.alignment import facts_of
from undulog.analysis.compare.side import ComparedSession, see
from undulog.analysis.signals.stretch import Options
from undulog.capture import SessionView
from undulog.capture.common.errors import UndulogError, UsageError
from undulog.capture.robot.model import Robot

from ..draw.drawing import palette_of
from ..draw.plots.gait import rhythm_of
from ..draw.scene.motion import HeadPath, read_head
from ..feed.recording import Recording, write_recording
from ..samples.content import Color
from ..samples.timeline import Rhythm
from ..samples.tracks import Track, read_columns, wanted_fields

COMPARED = "/compared"
"""Where everything goes that belongs to no single session."""

_TOPICS = ("/joint_states", "/gait")


@dataclass(frozen=True)
class Side:
    """What side by side needs of a session, beside its own recording.

    Attributes:
        name: What it is called, e.g. ``twin``.
        path: The session's file.
        start_ns: Time of its first sample [Unix ns].
        end_ns: Time of its last one [Unix ns].
        verdict: Health of the recording, or None where nobody judged it.
        robot: Its robot, or None.
        measured: Measured joint angles [rad].
        head: The head's path, or None where no body can be drawn.
        rhythm: The gait's phase, or None where none was logged.
        palette: Colour by joint name.
        facts: What it says of how it was made.
    """

    name: str
    path: Path
    session_id: str
    start_ns: int
    end_ns: int
    verdict: str | None
    robot: Robot | None
    measured: tuple[Track, ...]
    head: HeadPath | None
    rhythm: Rhythm | None
    palette: Mapping[str, Color]
    facts: Mapping[str, str]

    @property
    def entity(self) -> str:
        """Path under which all of its entities are."""
        return f"/{rr.escape_entity_path_part(self.name)}"

    @property
    def own(self) -> str:
        """Path under which its comparison with the first session is."""
        return f"{COMPARED}/{rr.escape_entity_path_part(self.name)}"

    @property
    def runs_back(self) -> bool:
        """Whether the gait's phase falls."""
        return self.rhythm is not None and bool(self.rhythm.cycles[-1] < self.rhythm.cycles[0])

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, head to tail."""
        if self.robot is not None:
            return self.robot.joint_names
        return tuple(track.name for track in self.measured)


def names_of(files: Sequence[Path], wanted: Sequence[str] | None) -> tuple[str, ...]:
    """What the sessions are called.

    Args:
        wanted: Names that were asked for, or None for the files' own.

    Returns:
        A name a session, all different.

    Raises:
        UsageError: If there are too few or too many, or they can't be told apart.
    """
    if wanted is None:
        stems = [file.stem for file in files]
        if len(set(stems)) == len(stems) and COMPARED.strip("/") not in stems:
            return tuple(stems)
        return tuple(f"{stem} {i + 1}" for i, stem in enumerate(stems))
    names = [name.strip() for name in wanted]
    if len(names) != len(files):
        raise UsageError(
            f"--names gives {len(names)} names for {len(files)} sessions; give one each, with "
            "commas between them, e.g. --names robot,twin"
        )
    if not all(names) or len(set(names)) < len(names):
        raise UsageError(f"--names {','.join(names)}: every session needs a name of its own")
    if COMPARED.strip("/") in names:
        raise UsageError(f"--names: {COMPARED.strip('/')!r} is where the differences go")
    return tuple(names)


def read_side(session: SessionView, name: str) -> Side:
    """Read what side by side needs of a session."""
    wanted = {topic: ["position"] for topic in _TOPICS if topic in wanted_fields(session)}
    columns = read_columns(session, wanted)
    measured = columns.get(("/joint_states", "position"), ())
    head = None
    if session.robot is not None and measured:
        head = read_head(session, session.robot, measured, [])  # its recording says what is missing
    return Side(
        name=name,
        path=session.path,
        session_id=session.session_id,
        start_ns=session.start_ns,
        end_ns=session.end_ns,
        verdict=session.verdict,
        robot=session.robot,
        measured=measured,
        head=head,
        rhythm=rhythm_of(columns.get(("/gait", "position"), ())),
        palette=palette_of(session.robot, [track.name for track in measured]),
        facts=facts_of(session),
    )


def convert(session: SessionView, path: Path) -> tuple[Recording, ComparedSession | None]:
    """Write the session's own recording, and take from it what a comparison needs.

    Returns:
        The recording, and the analysis, or None where the session can't be analysed; why is
        among the recording's warnings.

    Raises:
        DataError: If the session holds nothing that can be drawn.
        LogWriteError: If the file can't be written.
    """
    notes: list[str] = []
    seen: ComparedSession | None = None
    try:
        seen = see(session, Options(), notes.append)
    except UndulogError as error:  # a session without a gait can be seen too
        notes.append(f"not analysed: {error}")
    session.forget()
    analysis = None if seen is None else seen.analysis
    return write_recording(session, path, analysis=analysis, notes=notes), seen
