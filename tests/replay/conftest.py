"""A small session with known columns, recordings read back, and a headless viewer."""

import io
import math
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

import numpy as np
import pytest

from support import processes
from support.built_results import around, passive_joint
from support.written_topics import EPOCH_NS, GAIT, write_topics
from undulog.analysis.common.estimate import Provenance
from undulog.analysis.parts.gait.result import GaitFacts, Window
from undulog.analysis.results.analysis import Analysis, SessionFacts
from undulog.analysis.results.coupling import Coupling
from undulog.capture import Session, load_robot
from undulog.capture.robot.model import Plane


@pytest.fixture(scope="session")
def snake25():
    """The 25-joint robot."""
    return load_robot("snake25")


@dataclass(frozen=True)
class Truth:
    """What was written: times since the start [s], arrays of shape (n, m)."""

    t: np.ndarray
    command: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray
    head: np.ndarray
    phase: np.ndarray

    @property
    def t_ns(self):
        """Unix times [ns]."""
        return EPOCH_NS + np.round(self.t * 1e9).astype(np.int64)


@pytest.fixture(scope="session")
def truth(snake25):
    """Three seconds at 100 Hz: a serpentine wave on the yaw joints, 1.5 cycles, head moving."""
    t = np.arange(300) / 100.0
    yaw = snake25.joint_indices(Plane.HORIZONTAL)
    phase = 2 * np.pi * 0.5 * t
    k = np.arange(len(yaw))
    command = np.zeros((len(t), 25))
    command[:, yaw] = 0.4 * np.sin(phase[:, None] - k * np.pi / 3)
    position, velocity, effort = (np.zeros_like(command) for _ in range(3))
    late = phase[:, None] - k * np.pi / 3 - np.radians(7 + 0.5 * k)
    position[:, yaw] = 0.38 * np.sin(late)
    velocity[:, yaw] = 0.38 * np.pi * np.cos(late)
    effort[:, yaw] = 0.1 * np.cos(late + 1.2)
    head = np.stack([0.2 * t, 0.05 * np.sin(phase), np.full_like(t, 0.025)], axis=1)
    return Truth(t, command, position, velocity, effort, head, phase)


@pytest.fixture(scope="session")
def write(snake25, truth):
    """A function that writes the session, all of it or without some parts."""

    def write_session(
        path,
        *,
        robot=True,
        odometry=True,
        gait=True,
        effort=True,
        position=None,
        keep=None,
        session_id="made-for-tests",
    ):
        kept = slice(None) if keep is None else keep
        names, drive = snake25.joint_names, [truth.velocity[kept], truth.effort[kept]]
        angles = (truth.position if position is None else position)[kept]
        amplitude = np.full(len(truth.t), 0.4)
        topics = {
            "/joint_commands": (names, "rad", truth.command[kept]),
            "/joint_states": (names, "rad", angles, *(drive if effort else [])),
            "/joint_current": (names, "A", truth.effort[kept]),
            "/joint_voltage": (names, "V", np.full_like(angles, 6.0)),
            "/gait": (GAIT, "rad", np.stack([amplitude, truth.phase], axis=1)[kept]),
        }
        if not gait:
            del topics["/gait"]

        def begin(writer):
            writer.set_verdict("good")
            if gait:
                mode, log = writer.string("/gait/mode"), writer.log("/rosout")
                mode.write(EPOCH_NS, "walk")
                log.write(EPOCH_NS + 5, "info", "drive", "start")
                mode.write(EPOCH_NS + 1_000_000_000, "avoid")
                log.write(EPOCH_NS + 1_000_000_000, "error", "drive", "wall ahead")

        return write_topics(
            path,
            truth.t_ns[kept],
            topics,
            head=truth.head[kept] if odometry else None,
            begin=begin,
            session_id=session_id,
            robot=snake25 if robot else None,
            clock={"robot": "simulated"},
        )

    return write_session


@pytest.fixture(scope="session")
def session_file(write, tmp_path_factory):
    """The whole session."""
    return write(tmp_path_factory.mktemp("session") / "made.mcap")


@pytest.fixture(scope="session")
def write_long(snake25):
    """Writes minutes of all joints at 5 Hz: more than a brief survey reads."""

    def write_session(path, *, seconds=400, odometry=True, heat_from_s=0.0, last_from_s=0.0):
        names = snake25.joint_names
        t = np.arange(5 * seconds) / 5
        phase = 2 * np.pi * 0.25 * t
        wave = phase[:, None] - np.arange(25) * np.pi / 6
        swing = np.where(np.arange(25) % 2, 0.3, 0.4)  # one plane moves more
        heat = np.tile(30.0 + 0.01 * t[:, None], 25)
        heat[t < last_from_s, 24] = np.nan
        heat[t < heat_from_s] = np.nan
        measured = 0.9 * swing * np.sin(wave - 0.1)
        speed = 0.9 * swing * 0.5 * np.pi * np.cos(wave - 0.1)
        topics = {
            "/joint_commands": (names, "rad", swing * np.sin(wave)),
            "/joint_states": (names, "rad", measured, speed, 0.1 * np.cos(wave)),
            "/joint_temperature": (names, "degC", heat),
            "/gait": (GAIT, "rad", np.stack([np.full(t.size, 0.4), phase], axis=1)),
        }
        head = np.outer(t, [0.1, 0.0, 0.0]) if odometry else None
        times_ns = EPOCH_NS + np.round(t * 1e9).astype(np.int64)
        return write_topics(path, times_ns, topics, head=head, session_id="long", robot=snake25)

    return write_session


@pytest.fixture(scope="session")
def analysis(snake25):
    """An analysis with made-up but distinct numbers a joint."""
    joints, lags = [], {"horizontal": -math.pi / 3}
    for i, joint in enumerate(snake25.joints):
        result = replace(passive_joint(joint.name, str(joint.plane)), energy_net_j=0.01 * i - 0.02)
        if joint.plane is Plane.HORIZONTAL:
            gain, lag = around(0.95 + 0.004 * i, 0.01), around(math.radians(7.0 + 0.3 * i), 0.02)
            result = replace(result, command_amplitude_rad=0.4, gain=gain, lag_rad=lag)
        joints.append(result)
    return Analysis(
        session=SessionFacts("made-for-tests", "made.mcap", "snake25", EPOCH_NS, 3.0, "good"),
        gait=GaitFacts(around(0.5, 0.01), (Window(0.0, 2.0, 1.0),), "head-to-tail", lags),
        joints=tuple(joints),
        body=None,
        heterogeneity={},
        coupling=Coupling(identifiable=False, why="one gait"),
        warnings=(),
        provenance=Provenance("", {}, {}, {}),
    )


class Recorded:
    """A recording read back with Rerun's own reader."""

    def __init__(self, path, identity=None):
        from rerun.chunk import RrdReader

        self._reader = RrdReader(path)
        stores = self._reader.recordings()
        chosen = [store for store in stores if identity in (None, store.recording_id)]
        self._chunks = self._reader.stream(store=next(iter(chosen), None)).to_chunks()

    @property
    def stores(self):
        """(application, recording id) of each recording in the file."""
        return [(s.application_id, s.recording_id) for s in self._reader.recordings()]

    @property
    def entities(self):
        """Paths of all entities."""
        return {chunk.entity_path for chunk in self._chunks}

    def statics(self, entity, component):
        """Values of a static component, a list each."""
        static_chunks = (
            chunk for chunk in self._chunks if chunk.entity_path == entity and chunk.is_static
        )
        batches = (chunk.to_record_batch() for chunk in static_chunks)
        return [b.column(component).to_pylist()[0] for b in batches if component in b.schema.names]

    def static(self, entity, component):
        """First value of a static component, a list."""
        return next(iter(self.statics(entity, component)))

    def column(self, entity, component):
        """Rows of a component in file order: a list of lists."""
        batches = self._temporal(entity)
        return [row for batch in batches for row in batch.column(component).to_pylist()]

    def rows(self, entity, component):
        """Session time [ns] to values, in order; rows without any are left out."""
        pairs = zip(self.times(entity).tolist(), self.column(entity, component), strict=True)
        return dict(sorted((t, v) for t, v in pairs if v is not None))

    def times(self, entity, timeline="session_time"):
        """Times of an entity's rows [ns]; rows that are not on the timeline are missing."""
        times = [
            batch.column(timeline).cast("int64").to_numpy()
            for batch in self._temporal(entity)
            if timeline in batch.schema.names
        ]
        return np.concatenate([np.zeros(0, dtype=np.int64), *times])

    def _temporal(self, entity):
        return [
            chunk.to_record_batch()
            for chunk in self._chunks
            if chunk.entity_path == entity and not chunk.is_static
        ]


@pytest.fixture(scope="session")
def read_back():
    """Opens a recording with Rerun's own reader."""
    return Recorded


@pytest.fixture(scope="session")
def recording(session_file, analysis, tmp_path_factory):
    """The whole session as a recording: (what was reported, what is in the file)."""
    from undulog.replay.recording import write_recording

    path = tmp_path_factory.mktemp("recording") / "made.rrd"
    with Session.open(session_file) as session:
        written = write_recording(session, path, analysis=analysis)
    return written, Recorded(path)


@pytest.fixture(scope="session")
def rerun_command():
    """Runs Rerun's own command line; returns its standard output."""
    from undulog.replay.viewer import viewer_binary

    def run(*arguments):
        return processes.run(viewer_binary(), *arguments, timeout=120, code=0).stdout

    return run


@pytest.fixture(scope="module")
def show(vulkan):
    """Opens a recording at a time in a headless viewer of its own: a viewer keeps its layout."""
    from undulog.replay.viewer import HeadlessViewer

    with ExitStack() as stack:

        def start(recording, seconds):
            viewer = stack.enter_context(HeadlessViewer())
            viewer.open(recording, seconds)
            return viewer

        yield start


@pytest.fixture(scope="session")
def rgb():
    """Turns a PNG into an array of integers, shape (height, width, 3)."""
    from PIL import Image

    return lambda png: np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)


@pytest.fixture(scope="session")
def sizes(rgb):
    """Height and width of each view that isn't behind a tab."""

    def in_front(viewer):
        shapes = []
        for name in viewer.views:
            with suppress(ConnectionError):  # behind a tab
                shapes.append(rgb(viewer.picture(name)).shape[:2])
        return shapes

    return in_front
