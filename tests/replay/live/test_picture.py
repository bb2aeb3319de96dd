"""What the live view draws: each message once, as the replay of the session has it."""

import numpy as np
import pytest

from support.live_stage import EPOCH_NS, seen_live
from support.written_topics import write_topics
from undulog.capture import Session
from undulog.replay.recording import write_recording

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def live(session_file, tmp_path_factory, read_back):
    """The whole session seen live: (what the relay reports, what it drew)."""
    report, output = seen_live(session_file, tmp_path_factory.mktemp("live"))
    return report, read_back(output)


@pytest.fixture(scope="module")
def replay(session_file, tmp_path_factory, read_back):
    """The same session as a replay."""
    path = tmp_path_factory.mktemp("replay") / "replay.rrd"
    with Session.open(session_file) as session:
        write_recording(session, path)
    return read_back(path)


def test_every_message_is_shown(live, session_file, opened):
    report, _ = live
    count = sum(channel.count for channel in opened(session_file).channels.values())
    assert report["sessions"] == ["made-for-tests"]
    assert (report["shown"], report["dropped"], report["unread"]) == (count, 0, 0)
    assert report["lag_s"]["p50"] > 0


def test_angles_and_power_are_those_that_were_measured(live, truth):
    _, drawn = live
    angle, scalar = "Angle:degrees", "Scalars:scalars"
    for entity, component, values, atol in (
        ("/joints/measured", angle, np.degrees(truth.position), 2e-6),
        ("/joints/commanded", angle, np.degrees(truth.command), 2e-6),
        ("/joints/error", angle, np.degrees(truth.position - truth.command), 2e-6),
        ("/power/mechanical", scalar, truth.effort * truth.velocity, 1e-8),
        ("/power/total/electrical", scalar, 6.0 * truth.effort.sum(axis=1)[:, None], 1e-6),
    ):
        rows = drawn.rows(entity, component)
        assert list(rows) == (truth.t_ns - EPOCH_NS).tolist()
        np.testing.assert_allclose(list(rows.values()), values, atol=atol)


@pytest.mark.parametrize(
    ("entity", "component"),
    [
        ("/world/snake/measured", "Capsules3D:translations"),
        ("/world/snake/measured", "Capsules3D:quaternions"),
        ("/world/snake/commanded", "Capsules3D:translations"),
        ("/world/snake/places", "Points3D:positions"),
        ("/joints/places/measured", "Scalars:scalars"),
        ("/joints/error", "Angle:degrees"),
        ("/signals/joint_current", "Scalars:scalars"),
        ("/gait/mode", "StateChange:state"),
        ("/events", "TextLog:text"),
    ],
)
def test_live_and_replay_draw_the_same(live, replay, entity, component):
    _, drawn = live
    seen, expected = drawn.rows(entity, component), replay.rows(entity, component)
    common = [t for t in expected if t in seen]
    assert len(common) >= 0.9 * len(expected)
    # A replay rounds its lines by no more than a thousandth of their range.
    atol = 1e-12
    if component in {"Scalars:scalars", "Angle:degrees"}:
        atol = 1e-3 * np.ptp(np.array(list(expected.values())), axis=0) + 1e-7
    for t in common:
        if isinstance(expected[t][0], str):
            assert seen[t] == expected[t]
        else:
            shown, other = (np.array(values[t], dtype=float) for values in (seen, expected))
            assert np.allclose(shown, other, atol=atol, equal_nan=True)


def test_entities_names_and_colours_are_the_replays_and_sent_once(live, replay):
    _, drawn = live
    assert {entity for entity in drawn.entities if not entity.startswith("/__")} <= replay.entities
    for entity in ("/joints/measured", "/joints/commanded", "/power/total/mechanical"):
        for component in ("SeriesLines:names", "SeriesLines:colors"):
            assert drawn.static(entity, component) == replay.static(entity, component)
    static = [chunk for chunk in drawn._chunks if chunk.entity_path == "/joints/measured"]
    assert sum(chunk.is_static for chunk in static) == 1


def test_a_gap_ends_lines_and_body_as_in_a_replay(snake25, truth, tmp_path, read_back, opened):
    t_ns = truth.t_ns + np.where(np.arange(len(truth.t_ns)) < 150, 0, 3_000_000_000)
    names = snake25.joint_names
    topics = {
        "/joint_commands": (names, "rad", truth.command),
        "/joint_states": (names, "rad", truth.position, truth.velocity, truth.effort),
    }
    head = np.outer(np.arange(len(t_ns)), [1e-3, 0.0, 0.0])
    path = write_topics(tmp_path / "gap.mcap", t_ns, topics, head=head, robot=snake25)
    _, output = seen_live(path, tmp_path)
    write_recording(opened(path), tmp_path / "replay.rrd")
    seen, expected = read_back(output), read_back(tmp_path / "replay.rrd")
    for entity in (
        "/joints/measured",
        "/joints/error",
        "/power/total/mechanical",
        "/world/snake/measured",
        "/world/snake/commanded",
        "/world/trail",
    ):
        assert seen.times(entity).tolist() == expected.times(entity).tolist(), entity
