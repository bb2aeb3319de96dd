"""Streams that Rerun or a disk lets stand still end in an error within the limit."""

import os
import sys
from contextlib import contextmanager

import pytest

from support.processes import python, run, wait_for
from undulog.capture import Session
from undulog.capture.common.errors import LogWriteError, NoAnswerError
from undulog.capture.common.files import part_file
from undulog.replay import recording, stream
from undulog.replay.recording import open_recording, recording_file, write_recording
from undulog.replay.stream import RrdFile

# The sink of the stream is a pipe that nobody empties: Rerun's own thread stands still.
STUCK = """
import os, sys, numpy as np, rerun as rr
from undulog.replay import recording, stream
from undulog.replay.recording import open_recording
stream.LIMIT_S = 1.0
reads, writes = os.pipe()
rec = open_recording("stuck", in_file=True)
rec.save(f"/dev/fd/{writes}")
for k in range(40):
    rec.log("picture", rr.Image(np.random.default_rng(k).integers(0, 255, (100, 100, 3), "uint8")))
try:
    rec.flush()
except stream.NoAnswerError as error:
    print(error, flush=True)
"""
# Files of this process end at a size; as on a full disk, a write fails there.
LIMITED = """
import resource, sys
from pathlib import Path
from undulog.capture import Session
from undulog.capture.common.errors import LogWriteError
from undulog.replay.recording import write_recording
session, folder = Path(sys.argv[1]), Path(sys.argv[2])
failed = []
for size in map(int, sys.argv[3:]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    try:
        with Session.open(session) as opened:
            write_recording(opened, folder / "run.rrd")
    except LogWriteError as error:
        failed.append(str(error))
    assert list(folder.iterdir()) == [], size
print(*failed, sep="\\n")
"""


def log_noise(rec, count):
    """Log pictures of 30 kB that don't compress."""
    import numpy as np
    import rerun as rr

    for k in range(count):
        pixels = np.random.default_rng(k).integers(0, 255, (100, 100, 3), "uint8")
        rec.log("picture", rr.Image(pixels))


@pytest.mark.slow
def test_a_stream_that_stands_still_ends_in_a_sentence_and_lets_the_process_end():
    done = python(STUCK, timeout=100, code=0)
    assert done.stdout.startswith("Rerun's recording stream did not answer within 1 s; ")


def test_a_disk_that_takes_nothing_is_an_error(tmp_path):
    # A pipe as the file: it takes 64 KiB, then a write waits for ever.
    draft = tmp_path / "a.rrd.part"
    os.mkfifo(draft)
    reads = os.open(draft, os.O_RDONLY | os.O_NONBLOCK)
    try:
        with RrdFile(draft, tmp_path / "a.rrd", limit_s=0.5) as file:
            rec = open_recording("a", in_file=True)
            file.connect(rec)
            log_noise(rec, count=20)
            rec.disconnect()  # all of it is in the pipe to our thread
            with pytest.raises(LogWriteError, match=r"a\.rrd: the disk took nothing within 0\.5 s"):
                file.finish()
    finally:
        os.close(reads)


@contextmanager
def stalled_part_file(path):
    """A part file on a disk that takes nothing: a pipe that nobody reads."""
    with part_file(path) as draft:
        draft.unlink()
        os.mkfifo(draft)
        reads = os.open(draft, os.O_RDONLY | os.O_NONBLOCK)
        try:
            yield draft
        finally:
            os.close(reads)


def test_while_a_disk_takes_nothing_rerun_is_waited_for_within_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(stream, "LIMIT_S", 0.5)
    monkeypatch.setattr(recording, "part_file", stalled_part_file)
    path = tmp_path / "a.rrd"
    with pytest.raises(NoAnswerError), recording_file(path, "a", "a", 0) as rec:  # noqa: PT012
        log_noise(rec, count=100)
        rec.flush()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_write_that_fails_anywhere_is_an_error_and_leaves_nothing(session_file, tmp_path):
    place = tmp_path / "empty"
    place.mkdir()
    whole = write_size(session_file, tmp_path)
    sizes = [0, 1, 4096, *range(20_000, whole, whole // 12), whole - 10_000]
    done = python(LIMITED, session_file, place, *sizes, timeout=280, code=0)
    assert done.stdout.splitlines() == [f"{place}/run.rrd: can't be written: File too large"] * len(
        sizes
    )


def write_size(session_file, folder):
    """Bytes of the recording of a session."""
    with Session.open(session_file) as session:
        return write_recording(session, folder / "whole.rrd").path.stat().st_size


def test_after_a_failed_write_the_rest_is_dropped_and_the_stream_ends(disk_of):
    disk = disk_of("64k")
    with RrdFile(disk / "draft", disk / "a.rrd") as file:
        rec = open_recording("a", in_file=True)
        file.connect(rec)
        log_noise(rec, count=100)
        with pytest.raises(LogWriteError, match=r"can't be written: No space left on device"):
            wait_for(rec.flush, "the error")
        rec.disconnect()
        wait_for(lambda: file.taken > 1_000_000, "the rest to be dropped")
        with pytest.raises(LogWriteError, match="No space left"):
            file.finish()


def test_a_file_that_no_stream_was_connected_to_is_empty(tmp_path):
    with RrdFile(tmp_path / "draft", tmp_path / "a.rrd") as file:
        file.finish()
    assert (tmp_path / "draft").read_bytes() == b""


@pytest.mark.nightly
def test_a_command_without_room_for_its_file_ends_with_a_sentence(session_file, tmp_path):
    words = f"ulimit -f 8; exec {sys.executable} -m undulog view '{session_file}' --save run.rrd"
    done = run("bash", "-c", words, cwd=tmp_path, code=1)
    assert done.stderr == "error: run.rrd: can't be written: File too large\n"
    assert list(tmp_path.iterdir()) == []
