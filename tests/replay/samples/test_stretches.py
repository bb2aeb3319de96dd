"""A session drawn stretch by stretch is the session drawn at once."""

import numpy as np
import pytest

from undulog.capture import Session, SessionWriter
from undulog.capture.robot.model import Plane
from undulog.replay.recording import write_recording
from undulog.replay.samples import timeline as stretches
from undulog.replay.samples.quantities import survey
from undulog.replay.samples.timeline import DrawnSpan

START = 1_735_689_600_000_000_000
DRAWN = {
    "/joints/measured": "Angle:degrees",
    "/joints/commanded": "Angle:degrees",
    "/joints/error": "Angle:degrees",
    "/joints/places/measured": "Scalars:scalars",
    "/power/mechanical": "Scalars:scalars",
    "/power/total/mechanical": "Scalars:scalars",
    "/signals/joint_temperature": "Scalars:scalars",
    "/world/snake/measured": "Capsules3D:translations",
    "/world/snake/commanded": "Capsules3D:quaternions",
    "/world/snake/places": "Points3D:positions",
    "/world/snake/place_names": "Points3D:positions",
    "/world/snake/ranges": "Arrows3D:vectors",
    "/world/trail": "LineStrips3D:strips",
}


@pytest.fixture(scope="module")
def session_file(snake25, tmp_path_factory):
    """Twelve seconds of noise and jitter, in turn, with lost samples and a pause from 4.2 to 5.9 s;
    the temperature comes ten times a second."""
    path = tmp_path_factory.mktemp("long") / "long.mcap"
    rng = np.random.default_rng(11)
    offset = np.linspace(0.0, 6e-3, 25)
    yaw = snake25.joint_indices(Plane.HORIZONTAL)
    names = snake25.joint_names
    with SessionWriter(path, session_id="long", epoch_ns=START, robot=snake25) as w:
        offsets = w.joint_state("/joint_sample_offset", names, unit="s")
        commands = w.joint_state("/joint_commands", names, unit="rad")
        states = w.joint_state("/joint_states", names, unit="rad", velocity=True, effort=True)
        warm = w.joint_state("/joint_temperature", names, unit="degC")
        gait = w.joint_state("/gait", ["horizontal.A", "horizontal.phase"], unit="rad")
        head = w.odometry("/odom", frame="world", child="link01")
        sight = w.range("/sonar", frame="sonar", min_range=0.02, max_range=5.0, field_of_view=0.3)
        for i in range(1200):
            t = i / 100.0
            if 4.2 <= t < 5.9:
                continue
            t_ns = START + i * 10_000_000 + int(rng.integers(0, 50_000))
            command, position = np.zeros((2, 25))
            command[yaw] = 0.4 * np.sin(3.0 * t - np.arange(13))
            position[yaw] = 0.38 * np.sin(3.0 * t - np.arange(13) - 0.1)
            position += rng.normal(0, 1e-3, 25)
            position[rng.random(25) < 0.01] = np.nan
            offsets.write(t_ns, offset)
            commands.write(t_ns, command)
            states.write(t_ns, position, rng.normal(size=25), rng.normal(size=25))
            if i % 10 == 0:
                warm.write(t_ns, 30.0 + rng.normal(size=25))
            gait.write(t_ns, np.array([0.4, 3.0 * t]))
            turn = np.array([0.0, 0.0, np.sin(0.1 * t), np.cos(0.1 * t)])
            head.write(t_ns, np.array([0.2 * t, 0.0, 0.025]), turn, np.zeros(3), np.zeros(3))
            sight.write(t_ns, 1.0 + 0.1 * np.sin(t))
    return path


def converted(session_file, path):
    with Session.open(session_file) as session:
        write_recording(session, path)


@pytest.mark.slow
def test_stretches_leave_no_seam(session_file, tmp_path, read_back, monkeypatch):
    converted(session_file, tmp_path / "whole.rrd")
    monkeypatch.setattr(stretches, "STRETCH_NS", 1_000_000_000)
    converted(session_file, tmp_path / "parts.rrd")
    whole, parts = read_back(tmp_path / "whole.rrd"), read_back(tmp_path / "parts.rrd")
    assert whole.entities == parts.entities >= DRAWN.keys()
    for entity, component in DRAWN.items():
        seen = whole.times(entity)
        assert seen.size > 50
        order, other = np.argsort(seen), np.argsort(parts.times(entity))
        # The row that ends a line lies a typical step after its end: of the whole, or of a part.
        np.testing.assert_allclose(seen[order], parts.times(entity)[other], rtol=0, atol=1e5)
        rows, same = whole.column(entity, component), parts.column(entity, component)
        for i, j in zip(order.tolist(), other.tolist(), strict=True):
            np.testing.assert_array_equal(rows[i], same[j])


def test_every_sample_is_in_one_stretch(session_file, monkeypatch):
    monkeypatch.setattr(stretches, "STRETCH_NS", 1_000_000_000)
    with Session.open(session_file) as session:
        surveyed = survey(session, 50.0)
        whole = session.joints("/joint_states").t_ns
        parts = list(stretches.stretches(session, surveyed.topics, surveyed.context_ns))
    assert len(parts) > 3
    for i, name in enumerate(("joint01", "joint02")):
        pieces = []
        for part in parts:
            tracks = part.columns["/joint_states", "position"]
            (track,) = [track for track in tracks if track.name == name]
            pieces.append(track.t_ns[part.span.rows(track.t_ns)])
        np.testing.assert_array_equal(np.concatenate(pieces), whole[i])


def test_a_span_is_half_open():
    t_ns = np.arange(10, dtype=np.int64)
    assert (DrawnSpan(2, 5).rows(t_ns), DrawnSpan().rows(t_ns)) == (slice(2, 5), slice(0, 10))


def test_a_survey_finds_lines_parts_and_how_far_to_look(session_file, snake25, opened):
    surveyed = survey(opened(session_file), 50.0)
    assert surveyed.parts["/joints/measured"] == (snake25.joint_names,)  # in turn: drawn together
    assert [sample.name for sample in surveyed.samples["/joints/measured"]] == list(
        snake25.joint_names
    )
    assert surveyed.topics["/joint_states"] == ["position", "velocity", "effort"]
    assert "/gait" not in surveyed.topics
    assert surveyed.context_ns == pytest.approx(6 * 100_000_000, rel=0.01)  # ten times a second
    assert surveyed.power_limit_w > 0.0
