"""CAN logs into sessions: a real one, and foreign formats as python-can writes them."""

import math
import re

import can
import cantools
import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from support.imported import export_file as export_log
from support.imported import import_can
from support.paths import TRACE as RECORDING
from support.written_frames import frames_of, log_messages
from undulog.capture import Session, load_robot
from undulog.capture.common.errors import ImportFormatError, OutputExistsError
from undulog.capture.common.process import StopRequest
from undulog.capture.exchange.frame_log import RELATIVE_EPOCH_NS
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages import frames as fr

T0 = 1_700_000_000.25

needs_recording = pytest.mark.skipif(
    not RECORDING.exists(), reason=f"the ArcSnake recording is not at {RECORDING}"
)


@pytest.fixture(scope="module")
def arcsnake(tmp_path_factory):
    path = tmp_path_factory.mktemp("arcsnake") / "run.mcap"
    return path, import_can(RECORDING, path, load_robot("arcsnake-joint"))


@needs_recording
def test_the_arcsnake_log_comes_back_bit_for_bit(arcsnake, tmp_path):
    path, report = arcsnake
    assert (report.frames, report.verdict, report.problems) == (19_297, "good", [])
    assert export_log(path, tmp_path / "back.log").facts["buses"] == {"can0": 19_297}
    assert (tmp_path / "back.log").read_bytes() == RECORDING.read_bytes()


@needs_recording
def test_the_arcsnake_frames_are_those_of_the_text(arcsnake):
    lines = [line.split() for line in RECORDING.read_text().splitlines()]
    frames = frames_of(arcsnake[0])
    assert frames["dir"].tolist() == [fr.DIR_TX if line[3] == "T" else fr.DIR_RX for line in lines]
    data = [bytes(row) for row in frames["data"]]
    assert data == [bytes.fromhex(line[2].removeprefix("14B#")) for line in lines]
    assert (np.bincount(frames["dir"]) == [9617, 9680]).all()


@needs_recording
def test_arcsnake_follows_its_command_with_slope_one_and_the_known_lag(arcsnake):
    with Session.open(arcsnake[0]) as session:
        assert session.robot == load_robot("arcsnake-joint")
        command = session.joints("/joint_commands").signal("joint01")
        position = session.joints("/joint_states").signal("joint01")
        start_ns = session.start_ns
        assert session.warnings == []
    assert (len(command.values), len(position.values)) == (1609, 1601)
    t_command, t = (command.t_ns - start_ns) * 1e-9, (position.t_ns - start_ns) * 1e-9
    fitted = (t >= 3) & (t <= 10.5)
    t, measured = t[fitted], position.values[fitted]

    def fit(lag):
        asked = np.interp(t - lag, t_command, command.values)
        basis = np.stack([asked, np.ones_like(asked)], axis=1)
        line, (misfit,), *_ = np.linalg.lstsq(basis, measured)
        return misfit, line[0]

    best = minimize_scalar(lambda lag: fit(lag)[0], bounds=(-0.05, 0.05), method="bounded")
    assert fit(best.x)[1] == pytest.approx(1.000, abs=0.002)
    assert best.x == pytest.approx(0.0074, abs=0.0005)


@needs_recording
def test_arcsnake_quantities_keep_their_own_times(arcsnake):
    with Session.open(arcsnake[0]) as session:
        frames = session.frames("/can/can0")
        is_state = np.isin(frames["data"][:, 0], [0x9C, 0xA4]) & (frames["dir"] == fr.DIR_RX)
        units = {"velocity": "rad/s", "current": "A", "temperature": "degC"}
        for topic, unit in units.items():
            signals = session.joints(f"/joint_{topic}")
            assert (signals.unit, signals.names) == (unit, ("joint01",))
            np.testing.assert_array_equal(signals.t_ns[0], frames["t_host_ns"][is_state])
        temperature = session.joints("/joint_temperature").values[0]
        assert 20 <= temperature.min() <= temperature.max() <= 26
        assert session.joints("/joint_states").unit == "rad"


@needs_recording
def test_the_same_log_gives_the_same_bytes(arcsnake, tmp_path):
    import_can(RECORDING, tmp_path / "again.mcap", load_robot("arcsnake-joint"))
    assert (tmp_path / "again.mcap").read_bytes() == arcsnake[0].read_bytes()


# -- foreign formats -----------------------------------------------------------------------


def test_error_and_fd_frames_of_a_blf(tmp_path):
    source, output = tmp_path / "log.blf", tmp_path / "run.mcap"
    messages = [
        can.Message(timestamp=T0, arbitration_id=1, is_extended_id=False, data=b"\1"),
        can.Message(timestamp=T0, is_error_frame=True, arbitration_id=0x80),
        can.Message(timestamp=T0, is_fd=True, arbitration_id=2, data=bytes(64)),
    ]
    report = import_can(log_messages(source, messages), output, load_robot("arcsnake-joint"))
    assert report.problems[0] == "1 error frames"
    assert report.problems[1].startswith("none of 2 CAN frames can be decoded")
    assert report.verdict == "degraded"
    with Session.open(output) as session:
        assert session.frames("/can/can0")["id_flags"].tolist() == [1, 0x80 | fr.ERROR_FLAG]
        (frame,) = session.fd_frames("/can_fd/can0")
        assert (frame["id_flags"], frame["len"]) == (2 | fr.EXTENDED_FLAG, 64)
        assert session.verdict == "degraded"


def test_a_cut_blf_is_reported(tmp_path):
    whole, cut = tmp_path / "whole.blf", tmp_path / "cut.blf"
    payloads = (np.random.default_rng(i).bytes(8) for i in range(300))
    messages = (can.Message(timestamp=T0 + i * 1e-3, data=d) for i, d in enumerate(payloads))
    log_messages(whole, messages, max_container_size=1000)
    data = whole.read_bytes()
    cut.write_bytes(data[: len(data) // 2])
    try:
        report = import_can(cut, tmp_path / "run.mcap", load_robot("arcsnake-joint"))
    except ImportFormatError as error:
        assert "can't be read after" in str(error)  # noqa: PT017
    else:
        assert "the file is cut short" in report.problems[0]
        assert 0 < report.frames < 300


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("x.blf", b"not a blf" * 50, "can't be read: not a BLF file"),
        ("x.db", b"not a database" * 50, "can't be read: file is not a database"),
        ("x.asc", b"", "holds no CAN frames"),
        ("x.mf4", b"not a measurement" * 50, "can't be read: not an MF4 file"),
        ("x.log.gz", b"not gzip", "can't be read: Not a gzipped file"),
        ("x.xyz", b"", "is of no format that can be imported: it is empty"),
    ],
)
def test_logs_that_are_none(name, data, message, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ImportFormatError, match=f"{re.escape(name)}.*{re.escape(message)}"):
        import_can(tmp_path / name, tmp_path / "run.mcap", load_robot("snake25"))
    assert [path.name for path in tmp_path.iterdir()] == [name]


# -- many servos on one bus ----------------------------------------------------------------

FRAME_S = 130e-6  # a frame of eight bytes at 1 Mbit/s
ROUNDS = 40


@pytest.fixture(scope="module")
def polled(tmp_path_factory):
    """25 servos commanded and polled in turn every 10 ms, by foreign encoder and writer (ASC)."""
    folder = tmp_path_factory.mktemp("polled")
    robot = load_robot("snake25")
    database = cantools.database.load_string(robot.databases[0][1], "dbc")
    truth = {"command": [], "state": []}

    def sent(name, values, t, *, is_rx=True):
        message = database.get_message_by_name(name)
        head = {"arbitration_id": message.frame_id, "is_extended_id": False, "is_rx": is_rx}
        return can.Message(timestamp=1.0 + t, data=message.encode(values), **head)

    with can.ASCWriter(folder / "poll.asc") as writer:
        for k in range(ROUNDS):
            t = k * 0.01
            for j, name in enumerate(robot.joint_names):
                if (k, j) == (7, 3):
                    continue  # one servo misses one round
                for kind, is_rx in (("command", False), ("state", True)):
                    t += FRAME_S
                    angle = 20 * math.sin(2 * math.pi * 0.5 * t + j * math.pi / 6)
                    values = {"position": angle}
                    if is_rx:
                        values |= {"velocity": 2 * angle, "torque": 3 * j, "current": -4 * j}
                        values |= {"temperature": 20 + j}
                    truth[kind].append((j, round(t * 1e6) * 1000, math.radians(angle)))
                    writer(sent(f"{name}_{kind}", values, t, is_rx=is_rx))
            t += FRAME_S
            for name, values in (
                ("ranges_1", {f"ir{i:02d}": 100 * i + k for i in range(1, 5)}),
                ("ranges_4", {"ir13": 1, "ir14": 2, "ir15": 3, "sonar": 3999}),
                ("acceleration", {"x": 0, "y": -500, "z": 1000}),
                ("magnetic_field", {"x": 20.5, "y": -30.25}),
            ):
                writer(sent(name, values, t))
    return folder / "run.mcap", import_can(folder / "poll.asc", folder / "run.mcap", robot), truth


# The writer counts from its first message, which is one frame after the first round's start.
LOG_START_NS = RELATIVE_EPOCH_NS - round(FRAME_S * 1e6) * 1000


def assert_samples(signals, truth):
    for j, (all_ns, all_values) in enumerate(zip(signals.t_ns, signals.values, strict=True)):
        kept = ~np.isnan(all_values)
        t_ns, angles = zip(*((t, angle) for joint, t, angle in truth if joint == j), strict=True)
        assert (all_ns[kept] - LOG_START_NS).tolist() == list(t_ns)
        half = math.radians(0.005) * 1.001  # of the bus's 0.01 degree
        np.testing.assert_allclose(all_values[kept], angles, rtol=0, atol=half)


def test_polled_states_keep_their_own_times(polled):
    path, report, truth = polled
    assert report.verdict == "good"
    with Session.open(path) as session:
        signals = session.joints("/joint_states")
        assert_samples(signals, truth["state"])
        assert np.isnan(signals.values[3]).sum() == 1
        velocity = session.joints("/joint_states", "velocity").values[5]
        kept, tolerance = ~np.isnan(velocity), {"rel": 0, "abs": math.radians(0.06)}
        assert velocity[kept] == pytest.approx(2 * signals.values[5][kept], **tolerance)
        assert np.nanmax(session.joints("/joint_states", "effort").values[9]) == 0.027
        assert session.joints("/joint_current").values[9] == pytest.approx(-0.036)
        assert session.joints("/joint_temperature").values[9].tolist() == [29.0] * ROUNDS


def test_polled_commands_are_logged_with_their_own_offsets(polled):
    path, _, truth = polled
    with Session.open(path) as session:
        assert session.channels["/joint_command_offset"].metadata["unit"] == "s"
        assert_samples(session.joints("/joint_commands"), truth["command"])


def test_sensors_on_the_bus(polled):
    with Session.open(polled[0]) as session:
        ranges = [(400 + k) * 1e-3 for k in range(ROUNDS)]
        assert session.table("/ir/04")["range"].to_numpy() == pytest.approx(ranges, rel=1e-6)
        assert session.table("/sonar")["range"].iloc[0] == pytest.approx(3.999, rel=1e-6)
        imu, compass = (session.table(topic).iloc[0] for topic in ("/imu", "/compass"))
        assert imu["linear_acceleration.z"] == pytest.approx(9.80665)
        assert imu["linear_acceleration.y"] == pytest.approx(-4.903325)
        assert compass["magnetic_field.x"] == pytest.approx(20.5e-6)
        assert compass["magnetic_field.y"] == pytest.approx(-30.25e-6)
        assert session.table("/compass")["magnetic_field.z"].isna().all()


def test_samples_of_one_stamp_and_other_frames_keep_their_times(import_text, opened):
    # A USB adapter may stamp several frames alike: two rounds then begin at one time.
    lines = []
    for k in range(3):
        t = 100.0 + k * 0.01
        for name, at in (("201", 0), ("101", 0), ("202", 500), ("102", 900)):
            data = "0100000000000000" if name[0] == "2" else "0100"
            way = "R" if name[0] == "2" else "T"
            lines.append(f"({t + at * 1e-6:.6f}) can0 {name}#{data} {way}\n")
    states = opened(import_text("".join(lines)).output).joints("/joint_states")
    assert (states.t_ns[1] - states.t_ns[0]).tolist() == [500_000] * 3


# -- the rest ------------------------------------------------------------------------------


TWO_BUSES = "".join(
    f"(100.{i:06d}) can{i % 2} {0x101 if i % 2 else 0x7FF:03X}#0000 T\n" for i in range(10)
)


@pytest.fixture
def import_text(tmp_path):
    """Imports a candump log with a shipped robot; the report names the session."""

    def run(text, robot="snake25", output="a.mcap", **options):
        (tmp_path / "x.log").write_text(text)
        return import_can(tmp_path / "x.log", tmp_path / output, load_robot(robot), **options)

    return run


def exported(report, **options):
    back = report.output.with_suffix(".log")
    export_log(report.output, back, **options)
    return back.read_text()


def test_the_bus_to_decode_can_be_chosen(import_text, tmp_path):
    first = import_text(TWO_BUSES)
    assert "/joint_commands" not in first.samples
    assert first.notes[-1] == "5 frames of bus can1 kept raw, not decoded"
    other = import_text(TWO_BUSES, output="b.mcap", bus="can1")
    assert other.samples["/joint_commands"] == 5
    assert exported(other) == TWO_BUSES
    assert exported(other, bus="can1", force=True).count("\n") == 5
    with pytest.raises(ImportFormatError, match="has no frames of bus can9; it has can0, can1"):
        import_text(TWO_BUSES, output="c.mcap", bus="can9")
    assert not (tmp_path / "c.mcap").exists()


def test_a_log_without_directions_comes_back_without(import_text):
    text = "(100.000000) can0 101#E803\n(100.010000) can0 101#E803\n"
    report = import_text(text)
    assert report.samples["/joint_commands"] == 2
    assert report.notes == ["the log has no directions: all frames count as received"]
    assert exported(report) == text


def test_times_that_go_back_are_reported_and_the_order_is_kept(import_text):
    times = [100, 100.2, 100.1, 100.3]
    text = "".join(f"({t:.6f}) can0 7FF#{i:02X} R\n" for i, t in enumerate(times))
    report = import_text(text)
    assert report.problems[0] == "1 frames are stamped before the one ahead"
    assert exported(report) == text


def trace(identifiers, data="0102"):
    lines = (f"({100 + i * 1e-3:.3f}) can0 {k:03X}#{data} R\n" for i, k in enumerate(identifiers))
    return "".join(lines)


def test_frames_of_another_robot_are_no_good_session(import_text):
    """8,400 frames of identifiers that snake25 doesn't have."""
    report = import_text(trace(0x6A0 + i % 12 for i in range(8400)))
    assert report.verdict == "degraded"
    (problem,) = report.problems
    assert problem.startswith("none of 8400 CAN frames can be decoded: the bus map of snake25 does")
    assert "not name 6A0 (700), 6A1 (700)" in problem
    assert "and 4 more" in problem
    assert "with the robot that sent them (--robot" in problem
    health = check_session(report.output)
    assert (health.verdict, health.reasons, health.stored) == ("degraded", (problem,), "degraded")


@pytest.mark.parametrize(("joints", "verdict"), [(25, "good"), (24, "degraded")])
def test_most_frames_may_be_of_other_devices_once_every_joint_is_there(
    joints, verdict, import_text
):
    report = import_text(trace([*range(0x201, 0x201 + joints), *[0x6A0] * 300], "01" * 8))
    assert report.verdict == verdict
    is_warned = any(text.startswith("only 24 of 324 CAN frames") for text in report.problems)
    assert is_warned == (verdict == "degraded")
    assert (
        any(text.startswith("only") for text in check_session(report.output).reasons) == is_warned
    )


def test_a_robot_without_a_bus_keeps_the_frames(import_text):
    report = import_text(TWO_BUSES, "snake13")
    assert report.problems == ["nothing decoded: the robot snake13 has no bus map"]
    assert set(report.samples) == {"/can/can0", "/can/can1"}


def test_nothing_is_overwritten(import_text, tmp_path):
    output = tmp_path / "a.mcap"
    output.write_text("precious")
    with pytest.raises(OutputExistsError):
        import_text(TWO_BUSES)
    with pytest.raises(ImportFormatError):
        import_text("(100.000000) can0 7FF#00 R\nnonsense\n", force=True)
    assert output.read_text() == "precious"


def test_a_stopped_import_leaves_a_whole_file(import_text, monkeypatch):
    monkeypatch.setattr("undulog.capture.exchange.frame_log.FRAMES_PER_BLOCK", 4)
    stop = StopRequest()
    stop.signal = 15
    report = import_text(TWO_BUSES, stop=stop)
    assert (report.complete, report.verdict, report.frames) == (False, "degraded", 4)
    with Session.open(report.output) as session:
        assert (session.warnings, session.verdict) == ([], "degraded")


def test_blocks_make_no_difference(tmp_path, polled, monkeypatch):
    source = polled[0].parent / "poll.asc"
    monkeypatch.setattr("undulog.capture.exchange.frame_log.FRAMES_PER_BLOCK", 37)
    import_can(source, tmp_path / "a.mcap", load_robot("snake25"))
    with Session.open(tmp_path / "a.mcap") as small, Session.open(polled[0]) as large:
        assert small.frames("/can/can0").tobytes() == large.frames("/can/can0").tobytes()
        for topic in ("/joint_states", "/joint_commands", "/joint_command_offset"):
            series, other = small.joints(topic), large.joints(topic)
            for part in ("t_ns", "values"):
                pairs = zip(getattr(series, part), getattr(other, part), strict=True)
                assert all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)
