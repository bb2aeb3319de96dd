"""The session of a drive over a bus: what each tick writes, read back."""

from pathlib import Path

import numpy as np
import pytest

from undulog.capture import Session
from undulog.capture.log.messages.frames import DIR_RX, DIR_TX, empty_frames
from undulog.capture.robot.model import ClockDomain
from undulog.sim.drive.loop import BusTick
from undulog.sim.drive.motion import find_motion
from undulog.sim.drive.outcome import DriveEnding, GateEvent, GatePhase, GateStep, Outcome
from undulog.sim.drive.over_bus import bus_plan
from undulog.sim.drive.session import BusSession, _mount_of, stamped
from undulog.sim.gait.contract import GaitTick

EPOCH_NS, MS = 1_735_689_600_000_000_000, 1_000_000
NO_TIME = np.iinfo(np.uint64).max
STOPPED = Outcome(DriveEnding.STOPPED, "asked", "the joints were held")


def frames(*rows, way=DIR_RX):
    """Frames: identifier, time of the host and of the device [ms]."""
    table = empty_frames(len(rows))
    for frame, (identifier, host_ms, device_ms) in zip(table, rows, strict=True):
        frame["id_flags"], frame["dlc"], frame["dir"] = identifier, 8, way
        frame["t_host_ns"] = EPOCH_NS + host_ms * MS
        frame["t_device_ns"] = NO_TIME if device_ms is None else device_ms * MS
    return table


def tick(
    number, phase=GatePhase.RUN, command=None, gait=None, *, received=(), sent=None, remarks=()
):
    angles = None if command is None else np.full(25, command)
    demand = None if command is None else angles + 0.5
    step = GateStep(phase, angles, demand, gait, tuple(remarks))
    return BusTick(number, step, received, frames() if sent is None else sent)


def gait(value, mode="walk", clamped=()):
    return GaitTick(np.zeros(25), np.array([value, 2.0 * value]), mode, clamped)


@pytest.fixture
def written(tmp_path):
    """Write ticks 10 ms apart and read the session."""
    opened = []

    def write(*ticks, end=STOPPED, remarks=(), names=("a", "b"), more=None):
        path = tmp_path / f"{len(opened)}.mcap"
        plan = bus_plan(find_motion("flat"), "can:virtual:one", path)
        session = BusSession(plan, ClockDomain.DEVICE, EPOCH_NS, names)
        for bus_tick in ticks:
            session.write(bus_tick, EPOCH_NS + 10 * MS * bus_tick.tick)
        if more is not None:
            more(session)
        if end is not None:
            session.finish(end, remarks)
        assert session.shortage is None
        session.close()
        session.close()
        opened.append(Session.open(path))
        return opened[-1]

    yield write
    for log in opened:
        log.close()


def remarks_of(session):
    return [message.msg for _, message in session.messages("/rosout")]


def test_each_tick_writes_what_was_sent_wanted_and_meant(written):
    session = written(
        tick(0, GatePhase.POSE),
        tick(1, GatePhase.APPROACH, 0.1),
        tick(2, GatePhase.RUN, 0.2, gait(1.0)),
        tick(3, GatePhase.RUN, 0.3, gait(2.0, "turn", ("joint02",))),
        tick(5, GatePhase.RUN, 0.4, gait(3.0, "turn", ("joint02", "joint03"))),
        tick(6, GatePhase.DONE),
    )
    commands = session.joints("/joint_commands").signal("joint07")
    np.testing.assert_allclose(commands.values, [0.1, 0.2, 0.3, 0.4])
    np.testing.assert_array_equal((commands.t_ns - EPOCH_NS) / MS, [10, 20, 30, 50])
    demand = session.joints("/gate/wanted").signal("joint07")
    np.testing.assert_allclose(demand.values, [0.6, 0.7, 0.8, 0.9])
    meant = session.joints("/gait").signal("b")
    np.testing.assert_array_equal(meant.values, [2.0, 4.0, 6.0])

    def changes(topic):
        return [((t_ns - EPOCH_NS) / MS, message.data) for t_ns, message in session.messages(topic)]

    assert changes("/gait/mode") == [(20, "walk"), (30, "turn")]
    assert changes("/gate/phase") == [
        (0, "reading the pose"), (10, "approach"), (20, "run"), (60, "done"),
    ]  # fmt: skip
    assert remarks_of(session) == [
        "joint02 clamped to the joint limits",
        "joint03 clamped to the joint limits",
        "stopped: asked; the joints were held",
    ]
    # The gait began after 20 ms, and settles as the scenario says.
    assert session.settle_s == pytest.approx(find_motion("flat").settle_s + 0.02)
    facts = session.metadata["undulog"]
    assert (facts["armed"], facts["source.one"], facts["driven"]) == (
        "yes",
        "can:virtual:one",
        "gait",
    )


def test_a_gait_without_values_has_a_mode_only(written):
    session = written(tick(0, GatePhase.RUN, 0.0, gait(1.0)), names=())
    assert "/gait" not in session.channels
    assert [message.data for _, message in session.messages("/gait/mode")] == ["walk"]


def test_all_frames_are_kept_and_what_was_sent_has_the_devices_time(written):
    session = written(
        tick(0, sent=frames((0x101, 0, 0), way=DIR_TX)),  # nothing was received yet
        tick(
            1,
            received=[frames((0x201, 9, 109), (0x202, 10, 112)), frames((0x203, 10, None))],
            sent=frames((0x101, 11, 0), (0x102, 12, 0), way=DIR_TX),
        ),
        tick(2, received=[frames((0x201, 20, 125))], sent=frames((0x101, 21, 0), way=DIR_TX)),
    )
    recorded = session.frames("/can/one")
    ours = recorded[recorded["dir"] == DIR_TX]
    assert ours["id_flags"].tolist() == [0x101, 0x101, 0x102, 0x101]
    host_ms = (ours["t_host_ns"].astype(np.int64) - EPOCH_NS) / MS
    assert host_ms.tolist() == [0, 11, 12, 21]
    assert ours["t_device_ns"][0] == EPOCH_NS  # as if the clocks were the same
    device_ms = ours["t_device_ns"][1:].astype(np.int64) / MS
    assert device_ms.tolist() == [113, 114, 126]  # 102 and 105 ms ahead
    others = recorded[recorded["dir"] == DIR_RX]
    assert others["id_flags"].tolist() == [0x201, 0x202, 0x203, 0x201]


def test_an_echo_of_a_joints_own_frame_is_no_angle_of_it(written):
    joint_frames = frames((0x201, 10, 10), (0x202, 10, 10))
    echo = frames((0x201, 20, 20), way=DIR_TX)
    session = written(tick(1, received=[joint_frames]), tick(2, sent=echo), tick(20))
    states = session.joints("/joint_states")
    assert [states.signal(f"joint0{k}").t_ns.size for k in (1, 2)] == [1, 1]


def test_a_time_before_the_devices_own_is_its_first_one(written):
    session = written(
        tick(0, received=[frames((0x201, 50, 0))], sent=frames((0x101, 10, 0), way=DIR_TX))
    )
    recorded = session.frames("/can/one")
    assert recorded[recorded["dir"] == DIR_TX]["t_device_ns"].tolist() == [0]


def test_an_event_is_written_once(written):
    def log(session):
        for level, text in (("info", "one"), ("warn", "two"), ("error", "one")):
            session.log_event(level, text)

    events = [GateEvent("warn", "gate: so"), GateEvent("info", "gate: run")]
    session = written(tick(0, remarks=events), tick(1, remarks=events[:1]), more=log)
    texts = remarks_of(session)
    assert texts[-3:] == ["one", "two", "stopped: asked; the joints were held"]
    assert texts[:3] == ["gate: so", "gate: run", "gate: so"]  # the gate tells it once itself


@pytest.mark.parametrize(
    ("outcome", "remarks", "verdict", "level"),
    [
        (Outcome(DriveEnding.COMPLETE, "", "at rest"), [], "good", 20),
        (
            Outcome(DriveEnding.STOPPED, "asked", "at rest"),
            [GateEvent("info", "late by")],
            "good",
            20,
        ),
        (
            Outcome(DriveEnding.COMPLETE, "", "at rest"),
            [GateEvent("warn", "left out")],
            "degraded",
            20,
        ),
        (Outcome(DriveEnding.FAULT, "lost", "at rest"), [GateEvent("warn", "left out")], "bad", 40),
    ],
)
def test_the_verdict_follows_the_outcome_and_the_warnings(
    outcome, remarks, verdict, level, written
):
    session = written(tick(0), end=outcome, remarks=remarks)
    how, why = outcome.how, outcome.why
    (_, first), *others = session.messages("/rosout")
    assert first.msg == (f"{how}: {why}; at rest" if why else f"{how}; at rest")
    assert (first.level, first.name) == (level, "drive")
    assert [event.msg for _, event in others] == [text for _, text in remarks]
    assert session.verdict == verdict
    reasons = session.metadata["undulog.health"].get("reasons", "[]")
    assert ("lost" in reasons, "left out" in reasons) == (
        verdict == "bad",
        verdict in {"bad", "degraded"},
    )
    assert "late by" not in reasons


def test_a_failure_is_the_verdict(written):
    session = written(tick(0), end=None, more=lambda writer: writer.fail("no gait"))
    assert (session.verdict, remarks_of(session)) == ("bad", ["no gait"])


def test_in_lockstep_frames_have_the_time_of_their_tick():
    received = [frames((0x201, 1, 2)), frames((0x202, 3, 4), (0x203, 5, 6))]
    sent = frames((0x101, 7, 8), way=DIR_TX)
    stamped_tick = stamped(BusTick(4, None, received, sent), EPOCH_NS)
    assert {
        time
        for block in (*stamped_tick.received, stamped_tick.sent)
        for time in block["t_host_ns"].tolist()
    } == {EPOCH_NS}
    assert stamped_tick.received[1]["t_device_ns"].tolist() == [4 * MS, 6 * MS]
    assert (stamped_tick.tick, len(stamped_tick.sent)) == (4, 1)
    assert sent["t_host_ns"].tolist() == [EPOCH_NS + 7 * MS]  # copies


def test_a_disk_is_named_by_where_it_is_mounted(tmp_path):
    assert _mount_of(tmp_path / "none" / "a.mcap").is_mount()
    assert _mount_of(tmp_path / "a.mcap") in (tmp_path, *tmp_path.resolve().parents)
    assert _mount_of(Path("/")) == Path("/")
    assert _mount_of(Path("/proc/self/status")) == Path("/proc")
