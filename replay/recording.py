"""A session as a Rerun recording: columns in, one .rrd file out.

The recording is a cache: the MCAP file stays the truth, and the same session always gives the
same recording id, so that a rebuilt recording takes the old one's place in the viewer.
"""

from __future__ import annotations

import traceback
import uuid
import warnings
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TypeVar

import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from undulog.analysis.results.analysis import Analysis
from undulog.analysis.session.cycle_maps import CycleMaps
from undulog.capture import SessionView
from undulog.capture.common.errors import LogWriteError
from undulog.capture.common.files import check_stop, part_file
from undulog.capture.common.process import StopRequest

from .draw.drawing import RerunDrawing, Sources, clock_of
from .draw.mean_cycle import Averaged
from .layout import build_blueprint
from .samples.content import Content, Layer, Named
from .samples.timeline import stretches
from .stream import BoundedStream, RrdFile

APPLICATION = "undulog"

Stream = TypeVar("Stream", bound=BoundedStream)

_RERUN = Path(rr.__file__).parent
_NAMESPACE = uuid.UUID("8f4b6f0e-6f0a-5d3f-9a53-5d1f7a3f2c11")


@dataclass(frozen=True)
class Recording:
    """What was written.

    Attributes:
        recording_id: Follows from the session id.
        warnings: What is missing or was assumed, a sentence each.
    """

    path: Path
    recording_id: str
    content: Content
    warnings: tuple[str, ...]


def recording_id(session_id: str) -> str:
    """Return the recording's id, the same for the same session on every machine.

    Args:
        session_id: The session's id.

    Returns:
        A name-based UUID (RFC 9562, version 5).
    """
    return str(uuid.uuid5(_NAMESPACE, session_id))


def write_recording(
    session: SessionView,
    path: Path,
    *,
    analysis: Analysis | None = None,
    steady: CycleMaps | None = None,
    named: Sequence[Named] = (),
    notes: Sequence[str] = (),
    layout: Callable[[Content], rrb.Blueprint] = build_blueprint,
) -> Recording:
    """Convert a session.

    Args:
        session: An open session, or a view of one.
        path: Where the .rrd file goes; an existing one is replaced when the new one is whole.
        analysis: The session's analysis, for the response bars and the cycles; None leaves them
            out.
        steady: The cycles of its steady gait, for a session whose phase was not logged.
        named: Modules that tests name, to be marked.
        notes: The caller's notes on the session, a sentence each.
        layout: Makes the blueprint from what the recording holds.

    Returns:
        The file and what it holds.

    Example::

        with undulog.Session.open("run.mcap") as session:
            undulog.write_recording(session, Path("run.rrd"))

    Raises:
        DataError: If the session holds nothing that can be drawn.
        LogWriteError: If the file can't be written.
    """
    layer = Layer(analysis, steady, tuple(named), tuple(notes))
    sources, clock = Sources.of(session), clock_of(session)
    identity = recording_id(session.session_id)
    with recording_file(path, identity, session.session_id, session.start_ns) as rec:
        averaged = Averaged(clock, analysis)
        drawing = RerunDrawing(rec, clock, sources, layer.named, averaged=averaged)
        session.forget()
        for stretch in stretches(session, sources.survey.topics, sources.survey.context_ns):
            drawing.write(stretch)
            rec.flush()  # what is drawn is written before more is read
        drawing.write_response(layer)
        drawing.write_words()
        drawing.write_others()
        drawing.write_cycles(layer)
        facts = drawing.write_facts(session, layer, drawing.content)
        rec.send_blueprint(layout(drawing.content))
    return Recording(path, identity, drawing.content, tuple(facts))


@contextmanager
def recording_file(
    path: Path, identity: str, name: str, start_ns: int, stop: StopRequest | None = None
) -> Generator[BoundedStream]:
    """Open a recording stream into a file, which is whole on leaving.

    Args:
        path: The .rrd file; an existing one is replaced when the new one is whole.
        identity: The recording's id.
        name: The recording's name.
        start_ns: Time at 0 of ``session_time`` [Unix ns].
        stop: Checked at the end; once it is requested, nothing is written.

    Raises:
        LogWriteError: If the file can't be written, or ``stop`` is requested.
    """
    with part_file(path) as draft, _rerun_errors(path), RrdFile(draft, path) as file:
        rec = open_recording(identity, in_file=True)
        file.connect(rec)
        try:
            send_properties(rec, name, start_ns)
            yield rec
        except BaseException as error:
            file.close()
            if isinstance(error, RuntimeError):  # what Rerun made of a failed write
                file.check()
            raise
        finally:
            rec.disconnect()
        file.finish()
        require_whole(draft, path)
        check_stop(path, stop)


def open_recording(
    identity: str, kind: type[Stream] = BoundedStream, *, in_file: bool = False
) -> Stream:
    """Return a recording stream for a session, without a sink.

    Args:
        identity: The recording's id.
        kind: Its class.
        in_file: Cut chunks by their size alone: those that a clock cuts differ from run to run.
    """
    rr.set_strict_mode(True)
    batching = rr.ChunkBatcherConfig(flush_tick=timedelta(days=1)) if in_file else None
    rec = kind(APPLICATION, recording_id=identity, send_properties=False, batcher_config=batching)
    rec.set_log_time_enabled(False)
    rec.set_log_tick_enabled(False)
    return rec


def send_properties(rec: rr.RecordingStream, name: str, start_ns: int) -> None:
    """Send the recording's name and the time of its start [Unix ns]."""
    rec.send_recording_name(name)
    rec.send_recording_start_time_nanos(start_ns)


@contextmanager
def _rerun_errors(path: Path) -> Generator[None]:
    """Raise a ``RuntimeError`` of Rerun's as a LogWriteError with the path."""
    try:
        yield
    except RuntimeError as error:
        raised_in = Path(traceback.extract_tb(error.__traceback__)[-1].filename)
        if _RERUN not in raised_in.parents:
            raise
        raise LogWriteError(path, f"can't be written: {error}") from error


def require_whole(draft: Path, path: Path) -> None:
    """Check that a recording has its footer: Rerun only logs what it failed to write.

    Args:
        path: What it will be called, for the message.

    Raises:
        LogWriteError: If it isn't whole.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            RrdReader(draft).store()
    except (RuntimeError, ValueError, Warning) as error:
        raise LogWriteError(path, "couldn't be written whole; is the disk full?") from error
