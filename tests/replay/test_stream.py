"""A session sent to a viewer while it is converted, received by Rerun itself, against its file."""

import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from support import golden_pictures
from support.processes import wait_for
from undulog.capture import Session
from undulog.capture.common.errors import UndulogError
from undulog.capture.common.process import StopRequest
from undulog.replay import progressive
from undulog.replay.draw.drawing import clock_of
from undulog.replay.numbers import Analysing, computed
from undulog.replay.recording import recording_id, write_recording
from undulog.replay.samples.content import Layer
from undulog.replay.viewer import Viewer

TOPICS = ("/joint_commands", "/joint_states")
NS = 1_000_000_000
RATE_HZ = 5
LONG_S = 400
pytestmark = pytest.mark.filterwarnings("ignore:RRD file has no footer")


class Told:
    """Hears how far it is; asks for an end as soon as the first picture is out, if wanted."""

    def __init__(self, stop=None):
        self.calls, self.stop = [], stop

    def update(self, done, note=""):
        self.calls.append((done, note))
        if self.stop is not None:
            self.stop.signal = signal.SIGINT


@contextmanager
def streaming(file, path):
    """A Rerun process that writes what it takes of a session, and what makes a task of it."""
    with (
        Session.open(file) as session,
        Viewer(["--save", str(path)]) as viewer,
        Analysing(file, TOPICS) as analysing,
    ):

        def task_of(bar, layer=None):
            return progressive.Task(session, layer or Layer(None), analysing, "session", bar)

        yield viewer, task_of


def ends_with_a_message(path, read_back):
    """Whether Rerun, which writes behind what it has received, is within no message."""
    try:
        read_back(path)
    except RuntimeError:
        return False
    return True


@pytest.fixture
def receive(tmp_path, read_back):
    """Streams a session to a Rerun process that writes what it takes; returns notes and file."""

    def stream(file, layer=None, identity=None):
        path = tmp_path / "received.rrd"
        with streaming(file, path) as (viewer, task_of):
            notes = progressive.show_session(task_of(Told(), layer), viewer, StopRequest())
            wait_for(lambda: ends_with_a_message(path, read_back), "the last message")
        return notes, read_back(path, identity)

    return stream


@pytest.fixture(scope="module")
def long_file(write_long, tmp_path_factory):
    return write_long(tmp_path_factory.mktemp("long") / "long.mcap")


def drawn(recorded):
    """Entities without Rerun's own."""
    return {entity for entity in recorded.entities if not entity.startswith("/__")}


def rows_of(recorded, entity):
    """Component to its rows in the order of session time, static ones left out."""
    by_component = {}
    for batch in recorded._temporal(entity):
        if "session_time" not in batch.schema.names:
            continue
        at = batch.column("session_time").cast("int64").to_numpy()
        for name in batch.schema.names:
            if ":" in name:
                rows = zip(at.tolist(), batch.column(name).to_pylist(), strict=True)
                by_component.setdefault(name, []).extend(rows)
    return {name: sorted(rows, key=lambda row: row[0]) for name, rows in by_component.items()}


def same(first, second):
    return repr(first) == repr(second)  # NaN is NaN here


def test_a_short_session_arrives_as_it_is_saved(receive, session_file, analysis, recording):
    notes, received = receive(session_file, Layer(analysis))
    written, saved = recording
    assert notes == written.warnings
    assert received.stores == [("undulog", written.recording_id)]
    assert drawn(received) == drawn(saved)
    for entity in drawn(saved):
        assert same(rows_of(received, entity), rows_of(saved, entity)), entity
    facts = received.static("/session", "TextDocument:text")
    assert "Not analysed" not in facts[0]
    assert "analysed:" not in facts[0]


@pytest.mark.nightly
def test_a_long_session_arrives_whole_after_a_brief_survey(receive, long_file, tmp_path, read_back):
    notes, received = receive(long_file)
    with Session.open(long_file) as session:
        layer = computed(session)
        path = tmp_path / "saved.rrd"
        shown = {"analysis": layer.analysis, "steady": layer.steady, "notes": layer.notes}
        written = write_recording(session, path, **shown)
    saved = read_back(path)
    assert notes == written.warnings
    assert drawn(received) == drawn(saved)
    for entity in drawn(saved):
        # Once each, at its own time, beginning and rest joined without a seam.
        ours, theirs = (np.sort(recording.times(entity)) for recording in (received, saved))
        np.testing.assert_array_equal(ours, theirs, entity)
    for entity in ("/joints/measured", "/power/mechanical", "/joints/places/commanded"):
        for component, rows in rows_of(saved, entity).items():
            ours = np.array([row for _, row in rows_of(received, entity)[component]], dtype=float)
            theirs = np.array([row for _, row in rows], dtype=float)
            room = np.nanmax(theirs, axis=0) - np.nanmin(theirs, axis=0)
            assert (np.nanmax(np.abs(ours - theirs), axis=0) <= 4e-3 * room + 1e-6).all()
    for entity in ("/world/snake/measured", "/world/snake/commanded", "/world/trail"):
        ours, theirs = rows_of(received, entity), rows_of(saved, entity)
        ours.pop("Capsules3D:colors", None)
        theirs.pop("Capsules3D:colors", None)
        assert same(ours, theirs), entity
    assert received.static("/session", "TextDocument:text")[0].startswith("**")


@pytest.mark.nightly
@pytest.mark.parametrize(
    "late", [pytest.param("heat_from_s", marks=pytest.mark.nightly), "last_from_s"]
)
def test_what_a_brief_survey_missed_makes_a_second_recording(receive, write_long, tmp_path, late):
    from_s = 365  # in a stretch that it doesn't look into
    file = write_long(tmp_path / "late.mcap", **{late: from_s})
    notes, received = receive(file, identity=recording_id("long/anew"))
    assert any("drawn anew" in note and "/joint_temperature" in note for note in notes)
    ids = {identity for _, identity in received.stores}
    assert ids == {recording_id("long"), recording_id("long/anew")}
    last = max(
        {entity for entity in received.entities if entity.startswith("/signals/joint_temperature")}
    )
    names = received.static(last, "SeriesLines:names")
    assert "joint25" in names
    at_s = received.times(last) / NS
    values = [row[names.index("joint25")] for row in received.column(last, "Scalars:scalars")]
    assert np.count_nonzero(np.isfinite(values)) == (LONG_S - from_s) * RATE_HZ
    assert at_s.max() == LONG_S - 1 / RATE_HZ


@pytest.mark.nightly
def test_without_odometry_the_body_is_drawn_throughout(
    receive, write_long, tmp_path, read_back, opened
):
    file = write_long(tmp_path / "still.mcap", odometry=False)
    notes, received = receive(file)
    write_recording(opened(file), tmp_path / "saved.rrd")
    saved = read_back(tmp_path / "saved.rrd")
    assert "no /odom in the session: the head is held at the origin" in notes
    for entity in ("/world/snake/measured", "/world/snake/commanded"):
        ours, theirs = (np.sort(recording.times(entity)) for recording in (received, saved))
        np.testing.assert_array_equal(ours, theirs, entity)


def test_the_layout_foreseen_is_that_of_the_analysed_session(tmp_path):
    with Session.open(golden_pictures.SESSION) as session:
        written = write_recording(session, tmp_path / "a.rrd", analysis=computed(session).analysis)
        rhythm = clock_of(session).rhythm
    content = written.content
    before = replace(content, charts=(), cycles=(), maps=(), mean=None)
    assert progressive.same_arrangement(progressive.predict_layout(before, rhythm), content)
    assert not progressive.same_arrangement(progressive.predict_layout(before, None), content)
    assert not progressive.same_arrangement(before, content)
    silent = replace(before, commanded=())
    assert progressive.predict_layout(silent, rhythm) == silent


def test_an_end_that_is_asked_for_comes_soon_and_ends_the_viewer(long_file, tmp_path):
    stop = StopRequest()
    bar = Told(stop)
    with streaming(long_file, tmp_path / "a.rrd") as (viewer, task_of):
        with pytest.raises(progressive.NoLongerWantedError):
            progressive.show_session(task_of(bar), viewer, stop)
        assert viewer.ended
    assert len(bar.calls) == 1


def test_a_viewer_that_dies_is_reported(long_file, tmp_path):
    with streaming(long_file, tmp_path / "a.rrd") as (viewer, task_of):

        class Killing(Told):
            def update(self, done, note=""):
                viewer._process.kill()

        with pytest.raises(UndulogError, match="viewer was ended by signal 9"):
            progressive.show_session(task_of(Killing()), viewer, StopRequest())


@pytest.mark.slow
def test_an_analysis_that_dies_is_a_note(tmp_path):
    with Analysing(tmp_path / "gone.mcap", TOPICS) as analysing:
        analysing.start()
        layer = wait_for(lambda: analysing.layer, "its note")
    assert layer.analysis is None
    assert "not analysed: the analysis ended with 1" in layer.notes[0]
    assert "gone.mcap" in layer.notes[0]
