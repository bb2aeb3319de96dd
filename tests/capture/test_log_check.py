"""``log check`` against planted truth: each fault is found, counted and placed, nothing else is."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mcap_ros2.writer import Writer as RosWriter

import undulog
from capture import SessionWriter, load_robot
from capture.log.bus_tally import BusTally, frame_bits
from capture.log.cdr import encode
from capture.log.chunk import walk_records
from capture.log.frames import ERROR_FLAG, EXTENDED_FLAG, empty_frames
from capture.log.schemas import message_type, schema_text
from capture.log.session_check import SessionHealth, check_session
from capture.log.tallies import SequenceTally, Timing, TimingTally

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
ROBOT = load_robot("snake25")
NAMES = ROBOT.joint_names
TICKS = 2000
JOINT_STATE = "sensor_msgs/msg/JointState"
ARCSNAKE = Path(__file__).parents[2].parent / "shared" / "data" / "arcsnake"

Edit = Callable[[int, np.ndarray, np.ndarray], int | None]
"""Tick, command and measured angles (edited in place) to stamp; None leaves the state out."""


def gait(tick: int) -> np.ndarray:
    return 0.4 * np.sin(np.pi * tick / 100 - 0.5 * np.arange(len(NAMES)))


def write(path: Path, edit: Edit | None = None, verdict: str | None = None) -> Path:
    """20 s of 25 joints at 100 Hz, with a fault planted by ``edit``."""
    noise = np.random.default_rng(3).normal(0.0, 1e-3, (TICKS, len(NAMES)))
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES, unit="rad", velocity=True)
        for tick in range(TICKS):
            command, angles = gait(tick), gait(tick - 5) + noise[tick]
            log_ns = EPOCH_NS + tick * STEP_NS
            t_ns: int | None = log_ns
            if edit is not None:
                t_ns = edit(tick, command, angles)
            commands.write(log_ns, command)
            if t_ns is not None:
                states.write(t_ns, angles, command, log_time_ns=log_ns)
        if verdict is not None:
            writer.set_verdict(verdict, ["so said the recorder"])
    return path


def at(tick: int) -> int:
    return EPOCH_NS + tick * STEP_NS


def timing_of(health: SessionHealth, topic: str = "/joint_states") -> Timing:
    (found,) = [each.timing for each in health.series if each.topic == topic]
    return found


def joint_of(health: SessionHealth, name: str, topic: str = "/joint_states"):
    (found,) = [each for each in health.joints if (each.topic, each.name) == (topic, name)]
    return found


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("clean") / "clean.mcap", verdict="good")


# -- the clean twin ----------------------------------------------------------------------------


def test_a_clean_session_is_good_without_a_word(clean: Path) -> None:
    health = check_session(clean)
    assert health.verdict == "good"
    assert health.findings == ()
    assert health.file.chunks == health.file.checked > 1
    timing = timing_of(health)
    assert (timing.count, timing.gaps, timing.missing) == (TICKS, 0, 0)
    assert timing.median_s == pytest.approx(0.01, abs=1e-12)
    assert timing.rate_hz == pytest.approx(100.0)
    assert timing.std_s == pytest.approx(0.0, abs=1e-6)
    assert {each.sequence.kind for each in health.channels} == {"counted"}
    assert {each.sequence.dropped for each in health.channels} == {0}
    assert joint_of(health, "joint07").frozen_s == 0


def test_the_verb_says_the_verdict_first_and_exits_0(
    clean: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert undulog.run(["log", "check", str(clean)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("good: s, snake25, 19.99 s\n")
    assert "stored verdict: good, the same" in said
    assert "0 messages dropped in 2 channels" in said


def test_json_is_one_object_and_says_whether_the_stored_verdict_differs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "s.mcap", verdict="bad")
    assert undulog.run(["log", "check", str(tmp_path / "s.mcap"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "good"
    assert found["stored"] == {
        "verdict": "bad",
        "reasons": ["so said the recorder"],
        "differs": True,
    }
    assert len(found["joints"]) == 2 * len(NAMES)
    assert found["series"][0]["timing"]["rate_hz"] == pytest.approx(100.0)


# -- planted in the rhythm ---------------------------------------------------------------------


def test_gaps_are_counted_measured_and_placed(tmp_path: Path) -> None:
    lost = {*range(300, 303), 900, *range(1500, 1530)}

    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        return None if tick in lost else at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    timing = timing_of(health)
    assert (timing.gaps, timing.missing) == (3, len(lost))
    assert timing.longest_s == pytest.approx(0.31)
    assert timing.longest_at_ns == at(1499)
    assert timing_of(health, "/joint_commands").gaps == 0
    assert health.verdict == "degraded"
    assert health.reasons == (
        "/joint_states: 3 gaps, 34 samples missing (1.70%); the longest is 0.31 s, at 14.990 s",
    )


def test_one_short_gap_is_told_and_no_fault(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        return None if tick == 700 else at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    assert health.verdict == "good"
    assert "1 gaps, 1 samples missing" in health.notes[0]


def test_a_tenth_lost_is_bad_and_exits_1(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        return None if tick % 8 == 1 else at(tick)

    path = write(tmp_path / "s.mcap", edit)
    assert check_session(path).verdict == "bad"
    assert undulog.run(["log", "check", str(path)]) == 1


def test_a_pause_can_be_cut_out_unless_it_is_most_of_the_session(tmp_path: Path) -> None:
    def edit(until: int) -> Edit:
        return lambda tick, command, angles: None if 400 <= tick < until else at(tick)

    once = check_session(write(tmp_path / "once.mcap", edit(900)))
    assert once.verdict == "degraded"
    assert timing_of(once).paused_s == pytest.approx(5.01)
    assert (timing_of(once).missing, timing_of(once).scattered) == (500, 0)
    assert check_session(write(tmp_path / "most.mcap", edit(1500))).verdict == "bad"


def test_a_series_that_ends_early_is_told(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        return None if tick >= 1500 else at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    assert health.reasons == ("/joint_states: ends 5 s before the session",)


def test_repeated_and_backward_stamps_are_counted(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        shift = -1 if tick % 200 == 100 else -3 if tick in {450, 850} else 0
        return at(tick + shift)

    timing = timing_of(health := check_session(write(tmp_path / "s.mcap", edit)))
    assert (timing.duplicates, timing.backward) == (10, 2)
    assert health.verdict == "degraded"


def test_jitter_has_the_standard_deviation_that_was_planted(tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    late = rng.normal(0.0, 3e5, TICKS).astype(int)

    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        return at(tick) + int(late[tick])

    steps = np.diff(at(0) + np.arange(TICKS) * STEP_NS + late) / 1e9
    timing = timing_of(check_session(write(tmp_path / "s.mcap", edit)))
    assert timing.std_s == pytest.approx(steps.std(), rel=1e-3)
    assert timing.median_s == pytest.approx(np.median(steps), rel=0.011)
    assert timing.p99_s == pytest.approx(np.quantile(steps, 0.99), rel=0.011)


@given(
    st.lists(st.integers(1, 10**10), min_size=1, max_size=300),
    st.lists(st.integers(0, 300), max_size=4),
)
def test_blocks_don_t_change_a_timing(steps: list[int], cuts: list[int]) -> None:
    t_ns = np.concatenate([[EPOCH_NS], EPOCH_NS + np.cumsum(steps)])
    whole, pieces = TimingTally(), TimingTally()
    whole.add(t_ns)
    for part in np.split(t_ns, sorted(cuts)):
        pieces.add(part)
    one, many = whole.result(), pieces.result()
    assert (one.count, one.gaps, one.missing) == (many.count, many.gaps, many.missing)
    assert one.median_s == pytest.approx(many.median_s)
    assert one.longest_s == many.longest_s == max(steps) / 1e9
    assert one.median_s == pytest.approx(
        np.quantile(steps, 0.5, method="inverted_cdf") / 1e9, rel=0.011
    )


# -- sequence numbers --------------------------------------------------------------------------


def write_raw(path: Path, sequences: list[int], **options: object) -> Path:
    """JointState messages of three joints with sequence numbers of our choice."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, **options)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", schema_text(JOINT_STATE).encode())
        for topic in ("/joint_commands", "/joint_states"):
            channel = writer.register_channel(topic, "cdr", schema)
            for k, sequence in enumerate(sequences):
                stamp = {"sec": at(k) // 10**9, "nanosec": at(k) % 10**9}
                values = {"header": {"stamp": stamp}, "name": list("abc"), "position": gait(k)[:3]}
                message = encode(message_type(JOINT_STATE), values)
                writer.add_message(channel, at(k), message, at(k), sequence)
        writer.finish()
    return path


def test_dropped_sequence_numbers_are_proved(tmp_path: Path) -> None:
    kept = [k for k in range(1, 500) if k not in {100, 101, 350}]
    health = check_session(write_raw(tmp_path / "s.mcap", kept))
    assert {each.sequence.dropped for each in health.channels} == {3}
    assert health.verdict == "degraded"
    assert "/joint_states: 3 of 499 messages were dropped (0.60%)" in health.reasons[1]


def test_zeros_are_no_sequence_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_raw(tmp_path / "s.mcap", [0] * 300)
    health = check_session(path)
    assert {each.sequence.kind for each in health.channels} == {"none"}
    assert {each.sequence.dropped for each in health.channels} == {None}
    undulog.run(["log", "check", str(path)])
    assert "no sequence numbers, so drops can't be proved" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("numbers", "kind", "dropped"),
    [
        ([2**32 - 2, 2**32 - 1, 0, 1], "counted", 0),
        ([5, 6, 7, 8, 10, 9, 11, 12, 13], "counted", 0),
        ([5, 6, 8, 9, 12], "counted", 3),
        ([7, 7, 7, 7], "not a count", None),
        ([3, 10, 17, 24], "not a count", None),
        ([4], "too few", None),
    ],
)
def test_what_sequence_numbers_prove(numbers: list[int], kind: str, dropped: int | None) -> None:
    tally = SequenceTally()
    for part in np.split(np.array(numbers), [1, 3]):
        tally.add(part)
    assert (tally.result().kind, tally.result().dropped) == (kind, dropped)


# -- planted in the values ---------------------------------------------------------------------


def test_nan_is_counted_by_joint(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        angles[4] = np.nan if 100 <= tick < 150 else angles[4]
        return at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    assert joint_of(health, "joint05").nan == 50
    assert sum(joint.nan for joint in health.joints) == 50
    assert health.reasons == ("/joint_states, joint05: 50 of 2000 samples are not a number",)


def test_a_frozen_joint_is_named_and_timed_and_a_resting_one_is_not(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        command[1], angles[1] = 0.0, 0.0  # told to rest
        angles[6] = 0.123 if 480 <= tick < 1230 else angles[6]
        return at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    assert joint_of(health, "joint07").frozen_s == 7  # whole seconds within 4.8 to 12.3 s
    assert joint_of(health, "joint07").frozen_at_ns == at(500)
    assert joint_of(health, "joint02").frozen_s == 0
    assert health.reasons == (
        "/joint_states, joint07: frozen for 7 s while its command moved, at 5.000 s",
    )


def test_half_of_the_joints_frozen_is_bad(tmp_path: Path) -> None:
    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        angles[:13] = 0.1
        return at(tick)

    assert check_session(write(tmp_path / "s.mcap", edit)).verdict == "bad"


def test_a_joint_held_at_its_limit_is_named_and_a_full_stroke_is_not(tmp_path: Path) -> None:
    limit = ROBOT.joints[0].upper

    def edit(tick: int, command: np.ndarray, angles: np.ndarray) -> int | None:
        angles[2] = command[2] = np.clip(2 * command[2], -limit, limit)
        angles[3] = command[3] = limit * np.sin(np.pi * tick / 100)
        return at(tick)

    health = check_session(write(tmp_path / "s.mcap", edit))
    clipped = np.mean(np.abs(0.8 * np.sin(np.pi * np.arange(TICKS) / 100 - 1)) >= limit - 1e-3)
    assert joint_of(health, "joint03").at_limit == pytest.approx(clipped)
    touching = 2 / np.pi * np.arccos(1 - 1e-3 / limit)
    assert joint_of(health, "joint04").at_limit == pytest.approx(touching, abs=0.015)
    assert {sentence.split(":")[0] for sentence in health.reasons} == {
        "/joint_states, joint03",
        "/joint_commands, joint03",
    }


# -- planted in the file -----------------------------------------------------------------------


def chunk_spans(path: Path) -> list[tuple[int, int]]:
    with path.open("rb") as stream:
        indexes = make_reader(stream).get_summary().chunk_indexes
    return [(index.chunk_start_offset, index.chunk_length) for index in indexes]


@pytest.mark.parametrize("part", [0.02, 0.5, 0.9])
def test_a_flipped_bit_is_found_and_bad(clean: Path, tmp_path: Path, part: float) -> None:
    start, length = chunk_spans(clean)[1]
    data = bytearray(clean.read_bytes())
    data[start + 60 + int(part * (length - 60))] ^= 0x10
    (tmp_path / "s.mcap").write_bytes(data)
    health = check_session(tmp_path / "s.mcap")
    assert health.verdict == "bad"
    assert health.file.checked == health.file.chunks - 1
    assert len(health.file.damage) == 1
    assert "the chunk at byte" in health.file.damage[0]
    lost = {each.sequence.dropped for each in health.channels}
    assert len(lost) <= 2
    assert 0 < sum(lost) < 2 * TICKS  # what the chunk held is proved by the numbers around it


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
@pytest.mark.parametrize("indexed", [True, False])
def test_a_flipped_bit_is_found_however_the_chunk_is_stored(
    tmp_path: Path, compression: CompressionType, indexed: bool
) -> None:
    kinds = IndexType.ALL if indexed else IndexType.NONE
    options = {"compression": compression, "chunk_size": 20_000, "index_types": kinds}
    path = write_raw(tmp_path / "s.mcap", list(range(500)), **options)
    data = bytearray(path.read_bytes())
    chunks = [span for span in walk_records(bytes(data), 8, len(data)) if span[0] == 6]
    assert check_session(path).file.damage == ()
    _, start, stop = chunks[2]
    data[(start + stop) // 2] ^= 0x10
    path.write_bytes(data)
    health = check_session(path)
    assert health.verdict == "bad"
    assert len(health.file.damage) == 1
    assert health.file.indexed is indexed


def test_an_index_that_lists_a_message_twice_is_found(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "s.mcap", list(range(100)))
    data = bytearray(path.read_bytes())
    _, start, _ = next(span for span in walk_records(bytes(data), 8, len(data)) if span[0] == 7)
    data[start + 14 : start + 22] = data[start + 30 : start + 38]  # no CRC covers it
    path.write_bytes(data)
    health = check_session(path)
    assert health.verdict == "bad"
    assert "does not list its messages" in health.file.damage[0]


def test_a_summary_that_counts_more_than_there_is_is_found(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "s.mcap", list(range(100)), enable_crcs=False)
    data = bytearray(path.read_bytes())
    counts = struct.pack("<HQHQ", 1, 100, 2, 100)
    assert data.count(counts) == 1
    at_count = data.index(counts) + 2
    data[at_count : at_count + 8] = struct.pack("<Q", 107)
    path.write_bytes(data)
    assert check_session(path).file.damage == (
        "the summary counts 107 messages of /joint_commands, 100 are in the file",
    )


def test_a_flipped_bit_in_an_attachment_is_found(clean: Path, tmp_path: Path) -> None:
    data = bytearray(clean.read_bytes())
    data[data.index(b"+-30 degrees")] ^= 1
    (tmp_path / "s.mcap").write_bytes(data)
    health = check_session(tmp_path / "s.mcap")
    assert health.verdict == "bad"
    assert "the attachment" in health.file.damage[0]


def test_a_cut_file_is_degraded_and_says_what_is_left(clean: Path, tmp_path: Path) -> None:
    start, length = chunk_spans(clean)[1]
    (tmp_path / "s.mcap").write_bytes(clean.read_bytes()[: start + length // 2])
    health = check_session(tmp_path / "s.mcap")
    assert health.file.truncated
    assert health.verdict == "degraded"
    assert health.reasons[0].startswith("the file is cut short")
    assert 0 < timing_of(health).count < TICKS
    assert health.stored is None


def test_a_file_without_index_is_degraded(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "s.mcap", list(range(300)), use_chunking=False)
    health = check_session(path)
    assert not health.file.truncated
    assert not health.file.indexed
    assert health.verdict == "degraded"
    assert timing_of(health).count == 300


def test_an_uncovered_chunk_is_told(tmp_path: Path) -> None:
    health = check_session(write_raw(tmp_path / "s.mcap", list(range(300)), enable_crcs=False))
    assert health.verdict == "good"
    assert "carry no CRC" in health.notes[0]


# -- foreign bags ------------------------------------------------------------------------------


def write_foreign(path: Path, topic: str, names: list[list[str]]) -> Path:
    """Each tick one message a list of names, as mcap-ros2-support writes them."""
    with path.open("wb") as stream:
        writer = RosWriter(stream)
        schema = writer.register_msgdef(JOINT_STATE, schema_text(JOINT_STATE))
        for tick in range(400):
            for k, group in enumerate(names):
                t_ns = at(tick) + k * 200_000
                stamp = {"sec": t_ns // 10**9, "nanosec": t_ns % 10**9}
                position = [float(np.sin(tick / 20 + k))] * len(group)
                message = {"header": {"stamp": stamp}, "name": group, "position": position}
                writer.write_message(topic, schema, message, log_time=t_ns, publish_time=t_ns)
        writer.finish()
    return path


def test_a_foreign_bag_is_checked_joint_by_joint(tmp_path: Path) -> None:
    path = write_foreign(tmp_path / "s.mcap", "/joint_states", [["a"], ["b"], ["c"]])
    health = check_session(path)
    assert {each.label: each.timing.gaps for each in health.series} == {
        "/joint_states (a)": 0,
        "/joint_states (b)": 0,
        "/joint_states (c)": 0,
    }
    assert [each.sequence.kind for each in health.channels] == ["none"]
    assert health.reasons == ("/joint_commands is missing; JointStates are on /joint_states",)


def test_missing_contract_topics_are_named(tmp_path: Path) -> None:
    health = check_session(write_foreign(tmp_path / "s.mcap", "/arm/state", [["a", "b"]]))
    assert health.verdict == "degraded"
    assert "/joint_states is missing; JointStates are on /arm/state" in health.reasons
    with SessionWriter(tmp_path / "t.mcap", session_id="t", epoch_ns=EPOCH_NS) as writer:
        writer.string("/gait/mode").write(EPOCH_NS, "walk")
    assert check_session(tmp_path / "t.mcap").verdict == "bad"


def test_a_joint_that_never_speaks_is_named(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        commands = writer.joint_state("/joint_commands", NAMES, unit="rad")
        states = writer.joint_state("/joint_states", NAMES[:-1], unit="rad")
        for tick in range(300):
            commands.write(at(tick), gait(tick))
            states.write(at(tick), gait(tick)[:-1] + 1e-3 * np.sin(tick))
    assert check_session(path).reasons == ("/joint_states never carries joint25",)


def test_what_is_no_log_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "x.mcap").write_bytes(b"no log at all")
    assert undulog.run(["log", "check", str(tmp_path / "x.mcap")]) == 1
    assert "not an MCAP file" in capsys.readouterr().err


# -- raw frames --------------------------------------------------------------------------------


def test_frame_lengths_are_those_of_the_paper() -> None:
    frames = empty_frames(4)
    frames["dlc"] = [8, 8, 0, 8]
    frames["id_flags"] = [0x123, 0x123 | EXTENDED_FLAG, 0x123, 0x123 | ERROR_FLAG]
    fewest, most = frame_bits(frames)
    # Davis et al. (2007): at most 135 bits with 11-bit and 160 with 29-bit identifiers, 8 bytes.
    assert most.tolist() == [135, 160, 55, 0]
    assert fewest.tolist() == [111, 131, 47, 0]


def test_load_rate_silence_and_errors_of_a_bus() -> None:
    tally = BusTally()
    frames = empty_frames(4001)
    t_ns = EPOCH_NS + np.arange(4001) * 1_000_000
    t_ns[2000:] += 1_500_000_000
    frames["t_host_ns"], frames["dlc"] = t_ns, 8
    frames["id_flags"][::100] = ERROR_FLAG
    for part in np.split(frames, [1, 700, 3000]):
        tally.add(part)
    bus = tally.result("/can/can0", 250_000)
    assert (bus.frames, bus.error_frames) == (4001, 41)
    assert bus.rate_hz == pytest.approx(4000 / 5.5)
    assert (bus.longest_s, bus.longest_at_ns) == (1.501, EPOCH_NS + 1_999_000_000)
    assert bus.load == pytest.approx((3960 * 111 / 5.5 / 250_000, 3960 * 135 / 5.5 / 250_000))
    assert bus.peak_load == pytest.approx((990 * 111 / 250_000, 990 * 135 / 250_000))


def test_frames_in_a_session_are_checked_as_they_were_logged(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    sizes = np.random.default_rng(5).integers(0, 40, 300)
    with SessionWriter(path, session_id="s", epoch_ns=EPOCH_NS, robot=ROBOT) as writer:
        bus = writer.frames("/can/can0")
        for k, size in enumerate(sizes.tolist()):
            frames = empty_frames(size)
            frames["t_host_ns"] = at(k) + np.arange(size) * 1000
            frames["dlc"] = 8
            bus.write(at(k), frames)
    health = check_session(path)
    (found,) = health.buses
    assert found.frames == sizes.sum()
    assert found.load is not None
    assert any("there are raw CAN frames" in sentence for sentence in health.reasons)


def test_a_real_trace_has_its_own_frame_count(tmp_path: Path) -> None:
    trace = ARCSNAKE / "linear_trajectory.candump.log"
    if not trace.is_file():
        pytest.skip("the recording of ArcSnake is not there")
    output = tmp_path / "s.mcap"
    done = undulog.run(["import", str(trace), "-o", str(output), "--robot", "arcsnake-joint"])
    assert done == 0
    health = check_session(output)
    (bus,) = health.buses
    assert bus.frames == len(trace.read_text().splitlines()) == 19_297
    assert bus.error_frames == 0
    # 1,787 frames a second of 111 to 135 bits on 1 Mbit/s.
    assert bus.load == pytest.approx((0.198, 0.241), abs=0.003)
    # The trace pauses before the motion and its log stamps have holes; it is fit for use.
    assert health.verdict == "degraded"
    stamps = [float(line.split(")")[0][1:]) for line in trace.read_text().splitlines()]
    assert bus.longest_s == pytest.approx(np.diff(stamps).max(), abs=1e-6)


def test_struct_of_the_chunk_header_is_that_of_the_spec(clean: Path) -> None:
    start, _ = chunk_spans(clean)[0]
    head = clean.read_bytes()[start + 9 : start + 9 + 32]
    begin, end, _, crc, size = struct.unpack("<QQQII", head)
    assert EPOCH_NS <= begin <= end <= at(TICKS)
    assert crc
    assert size == len("zstd")
