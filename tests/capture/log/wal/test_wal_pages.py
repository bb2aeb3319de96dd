"""The pages of a write-ahead log: who takes their faults, and what if somebody cuts them off."""

import os
import resource

import numpy as np
import pytest

from support.processes import wait_for
from support.read_back import summary_of
from support.recorders import ended, recording
from support.wal_messages import message
from undulog.capture import Session
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.log.wal.segment import Segment
from undulog.capture.log.wal.writer import WriteAheadLog
from undulog.capture.sources.unix_socket import FrameSender

PAGE = resource.getpagesize()


def page_faults():
    return resource.getrusage(resource.RUSAGE_THREAD).ru_minflt


def test_the_appending_thread_takes_no_page_faults(tmp_path, monkeypatch):
    payload, hold, holds = bytes(1000), Segment.hold, []

    def counted(segment, size):
        beyond = hold(segment, size)
        holds.append(size)
        return beyond

    monkeypatch.setattr(Segment, "hold", counted)
    faults = 0
    with WriteAheadLog(tmp_path / "w", sync_interval_s=1000.0) as wal:
        for _ in range(5):  # 50 pages before each sync, 250 in all
            before = len(holds)  # one that had begun may not have seen what is there now
            wait_for(lambda before=before: len(holds) >= before + 2, "the pages ahead")
            begun = page_faults()
            for _ in range(200):
                wal.append(1, 0, 0, 0, payload)
            faults += page_faults() - begun
            wal._sync()  # after which a page that is written faults anew
        wal.release(wal.position)
    assert faults < 1000 * 1040 / PAGE / 4  # one a page and one a sync without help


def test_a_page_that_is_written_no_more_is_synced_in_the_end(tmp_path):
    with WriteAheadLog(tmp_path / "w", sync_interval_s=0.02) as wal:
        for position in range(1, 1001):
            wal.append(*message(position))
        wait_for(lambda: wal.synced == 1000, "the last page")


@pytest.mark.slow
@pytest.mark.parametrize("size", [pytest.param(0, marks=pytest.mark.nightly), 2 * PAGE])
def test_a_recorder_whose_log_is_cut_short_ends_in_good_order(size, tmp_path):
    output, path = tmp_path / "run.mcap", tmp_path / "bus.sock"
    frame, accepted = empty_frames(1), 1
    with recording(output, f"bus=unix:{path}", "--quiet") as recorder, FrameSender(path) as sender:
        wait_for(lambda: sender.send(frame), "the recorder")
        before = sender.refused
        while recorder.poll() is None and sender.refused < before + 10:
            frame["t_device_ns"] = number = accepted
            accepted += sender.send(frame)
            if number == 500:
                taken = tmp_path / "run.mcap.wal" / "000001.seg"
                last = frame.tobytes()
                wait_for(lambda taken=taken, last=last: last[:8] in taken.read_bytes(), "all")
                os.truncate(taken, size)
        _, err = ended(recorder)
    assert recorder.returncode == 1, err
    assert "000001.seg: was cut short by another program" in err
    assert summary_of(output) is not None  # a whole file
    with Session.open(output) as session:
        frames = session.frames("/can/bus")
        np.testing.assert_array_equal(frames["t_device_ns"], np.arange(len(frames)))
        assert 501 <= len(frames) <= accepted
        assert not session.warnings
