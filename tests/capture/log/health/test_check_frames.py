"""`undulog log check` of raw frames: their lengths on the wire, load and silence of a bus."""

import numpy as np
import pytest

from support.checked_sessions import EPOCH_NS, ROBOT, at
from support.paths import TRACE
from undulog.capture import SessionWriter
from undulog.capture.log.health.bus_tally import BusTally, frame_bits
from undulog.capture.log.health.session_check import check_session
from undulog.capture.log.messages.frames import ERROR_FLAG, EXTENDED_FLAG, empty_frames

# -- raw frames --------------------------------------------------------------------------------


def test_frame_lengths_are_those_of_the_paper():
    frames = empty_frames(4)
    frames["dlc"] = [8, 8, 0, 8]
    frames["id_flags"] = [0x123, 0x123 | EXTENDED_FLAG, 0x123, 0x123 | ERROR_FLAG]
    fewest, most = frame_bits(frames)
    # Davis et al. (2007): at most 135 bits with 11-bit and 160 with 29-bit identifiers, 8 bytes.
    assert most.tolist() == [135, 160, 55, 0]
    assert fewest.tolist() == [111, 131, 47, 0]


def test_load_rate_silence_and_errors_of_a_bus():
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


def test_frames_in_a_session_are_checked_as_they_were_logged(tmp_path):
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
    (checked_bus,) = health.buses
    assert checked_bus.frames == sizes.sum()
    assert checked_bus.load is not None
    none = (
        f"none of {checked_bus.frames} CAN frames can be decoded: the bus map of {ROBOT.name} does"
    )
    assert any(sentence.startswith(none) for sentence in health.reasons)


def test_a_real_trace_has_its_own_frame_count(tmp_path, command):
    if not TRACE.is_file():
        pytest.skip("the recording of ArcSnake is not there")
    command("import", TRACE, "-o", tmp_path / "s.mcap", "--robot", "arcsnake-joint")
    health = check_session(tmp_path / "s.mcap")
    (bus,) = health.buses
    lines = TRACE.read_text().splitlines()
    assert (bus.frames, bus.error_frames) == (len(lines), 0) == (19_297, 0)
    # 1,787 frames a second of 111 to 135 bits on 1 Mbit/s.
    assert bus.load == pytest.approx((0.198, 0.241), abs=0.003)
    # The trace pauses before the motion and its log stamps have holes; it is fit for use.
    assert health.verdict == "degraded"
    stamps = [float(line.split(")")[0][1:]) for line in lines]
    assert bus.longest_s == pytest.approx(np.diff(stamps).max(), abs=1e-6)
