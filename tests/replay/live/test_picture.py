"""What the live view draws: each message once, as the replay of the session has it."""

import numpy as np
import pytest

from support.live_stage import EPOCH_NS, Recorder, Relay
from undulog.capture import Session
from undulog.replay.feed.recording import write_recording


@pytest.fixture(scope="module")
def live(session_file, tmp_path_factory, read_back):
    """The whole session seen live: (what the relay reports, what it drew)."""
    folder = tmp_path_factory.mktemp("live")
    socket_path = folder / "live.sock"
    relay = Relay(socket_path, folder / "live.rrd")
    try:
        recorder = Recorder(session_file, socket_path)
        recorder.connect()
        recorder.send()
        recorder.feed.close()
        return relay.finish(), read_back(relay.output)
    finally:
        relay.process.kill()
        relay.process.communicate()


@pytest.fixture(scope="module")
def replay(session_file, tmp_path_factory, read_back):
    """The same session as a replay."""
    path = tmp_path_factory.mktemp("replay") / "replay.rrd"
    with Session.open(session_file) as session:
        write_recording(session, path)
    return read_back(path)


def rows(recorded, entity, component):
    """Time to values, in order."""
    found = zip(recorded.times(entity).tolist(), recorded.column(entity, component), strict=True)
    return dict(sorted((t, v) for t, v in found if v is not None))


def same(first, second, atol=1e-12):
    return np.allclose(
        np.asarray(first, dtype=float), np.asarray(second, dtype=float), atol=atol, equal_nan=True
    )


def test_every_message_is_shown(live, session_file):
    report, _ = live
    with Session.open(session_file) as session:
        count = sum(channel.count for channel in session.channels.values())
    assert report["sessions"] == ["made-for-tests"]
    assert (report["shown"], report["dropped"], report["unread"]) == (count, 0, 0)
    assert report["lag_s"]["p50"] > 0


def test_angles_are_those_that_were_measured(live, truth):
    _, drawn = live
    t_ns = truth.t_ns - EPOCH_NS
    for entity, values in (
        ("/joints/measured", truth.position),
        ("/joints/commanded", truth.command),
        ("/joints/error", truth.position - truth.command),
    ):
        found = rows(drawn, entity, "Angle:degrees")
        assert list(found) == t_ns.tolist()
        np.testing.assert_allclose(list(found.values()), np.degrees(values), atol=2e-6)


def test_power_is_torque_times_velocity(live, truth):
    _, drawn = live
    found = rows(drawn, "/power/mechanical", "Scalars:scalars")
    assert list(found) == (truth.t_ns - EPOCH_NS).tolist()
    np.testing.assert_allclose(list(found.values()), truth.effort * truth.velocity, atol=1e-8)
    total = rows(drawn, "/power/total/electrical", "Scalars:scalars")
    shown = np.ravel(list(total.values()))
    np.testing.assert_allclose(shown, 6.0 * truth.effort.sum(axis=1), atol=1e-6)


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
    seen, expected = rows(drawn, entity, component), rows(replay, entity, component)
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
            assert same(seen[t], expected[t], atol)


def test_names_and_colours_are_the_replays(live, replay):
    _, drawn = live
    for entity in ("/joints/measured", "/joints/commanded", "/power/total/mechanical"):
        for component in ("SeriesLines:names", "SeriesLines:colors"):
            assert drawn.static(entity, component) == replay.static(entity, component)


def test_whatever_is_drawn_is_in_the_replay_too(live, replay):
    _, drawn = live
    assert {entity for entity in drawn.entities if not entity.startswith("/__")} <= replay.entities


def test_static_things_are_said_once(live):
    _, drawn = live
    chunks = [
        chunk
        for chunk in drawn._chunks
        if chunk.entity_path == "/joints/measured" and chunk.is_static
    ]
    assert len(chunks) == 1
