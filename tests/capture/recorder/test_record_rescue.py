"""A recorder whose folder is deleted or moved under it: no accepted frame is lost.

The sender numbers its frames and logs what the kernel accepted; the frames are read by mcap's own
reader.
"""

import json
import os
import shutil
import stat
from pathlib import Path

import pytest

from campaign.recording import check_kept, recorder, senders
from support.processes import wait_for
from support.read_back import messages_of

BUS = "a"


class Case:
    """A recorder in a folder of its own below the test's, and its sender."""

    def __init__(self, tmp_path):
        """Set the places."""
        self.sockets = tmp_path / "s"  # not in what is deleted
        self.above = tmp_path / "above"
        self.place = self.above / "place"
        self.moved = self.above / "moved"
        self.sockets.mkdir()
        self.place.mkdir(parents=True)

    def run(self, harm, *options):
        """Record, harm the folder, and wait for the end; return code, report, errors."""
        output = self.place / "run.mcap"
        options = ("--json", *options)
        with (
            recorder(self.sockets, (BUS,), options, output=output, stdout=-1) as running,
            senders(self.sockets, (BUS,), rate=2000, per_packet=8, seconds=600) as (self.sending,),
        ):
            self.sending.wait_for(200)
            harm(self)
            out, _ = running.communicate()
            self.sending.result()  # it ends with the connection
        errors = (self.sockets / "recorder.err").read_text()
        assert "Traceback" not in errors
        return running.returncode, json.loads(out), errors

    def check(self, session, command, tmp_path):
        """Every frame that the kernel accepted is in what is recovered, once and in order."""
        kept = tmp_path / "kept"
        kept.mkdir()
        command("log", "recover", session, "-o", kept / "x.mcap")
        accepted = self.sending.rows()[-1][1]
        assert accepted > 1000
        assert check_kept(kept, self.sending, accepted) == []


@pytest.fixture
def case(tmp_path):
    return Case(tmp_path)


def delete(case):
    shutil.rmtree(case.place)


def recreate(case):
    shutil.rmtree(case.place)
    case.place.mkdir()
    (case.place / "other").write_text("x")


def delete_file(case):
    (case.place / "run.mcap.part").unlink()


def delete_above(case):
    shutil.rmtree(case.above)


@pytest.mark.slow
@pytest.mark.parametrize(
    "harm",
    [
        delete,
        delete_file,
        *(pytest.param(h, marks=pytest.mark.nightly) for h in (recreate, delete_above)),
    ],
)
def test_what_was_deleted_is_rescued(harm, case, command, tmp_path):
    code, report, errors = case.run(harm)
    (rescue,) = report["rescued"]
    assert (code, report["files"]) == (1, [rescue])
    assert f"all that was accepted is in {rescue}" in errors
    assert "deleted while it was being written" in errors
    folder, name = os.path.split(rescue)
    above = {delete_file: case.place, delete_above: tmp_path}.get(harm, case.above)
    assert folder == str(above)
    assert name.startswith("run.rescued-")
    assert stat.S_IMODE(os.lstat(rescue).st_mode) == 0o600
    messages_of(Path(rescue))  # whole
    case.check(rescue, command, tmp_path)
    if harm is recreate:
        assert [path.name for path in case.place.iterdir()] == ["other"]


@pytest.mark.slow
def test_a_folder_that_was_moved_has_the_whole_session(case, command, tmp_path):
    code, report, errors = case.run(lambda case: case.place.rename(case.moved))
    session = case.moved / "run.mcap"
    assert (code, report["files"], report["rescued"]) == (1, [str(session)], [])
    assert f"was moved to {case.moved / 'run.mcap.part'}" in errors
    assert f"all that was accepted is in {session}" in errors
    assert [path.name for path in case.moved.iterdir()] == ["run.mcap"]
    messages_of(session)
    case.check(session, command, tmp_path)


@pytest.mark.slow
def test_a_write_ahead_log_that_is_deleted_ends_the_recording_with_a_whole_file(
    case, command, tmp_path
):
    code, report, errors = case.run(lambda case: shutil.rmtree(case.place / "run.mcap.wal"))
    session = case.place / "run.mcap"
    assert (code, report["files"], report["rescued"]) == (1, [str(session)], [])
    assert "run.mcap.wal: was deleted" in errors
    case.check(session, command, tmp_path)


@pytest.mark.slow
def test_nothing_is_rescued_where_there_is_no_room_and_that_is_said(case, disk_of, monkeypatch):
    case.above = disk_of("64m")
    case.place = case.above / "place"
    case.place.mkdir()
    monkeypatch.setenv("TMPDIR", str(case.above))

    def fill(case):
        with (case.above / "hog").open("wb", buffering=0) as hog:
            state = os.statvfs(case.above)
            os.posix_fallocate(hog.fileno(), 0, state.f_bavail * state.f_frsize - (1 << 20))
        (case.place / "run.mcap.part").unlink()

    code, report, errors = case.run(fill)
    assert (code, report["rescued"]) == (1, [])
    assert "no rescue file of" in errors
    assert "bytes free" in errors
    assert "run.mcap.wal still has is left" in errors


@pytest.mark.slow
def test_a_split_recording_reports_what_went_with_its_folder(case, command, tmp_path):
    def harm(case):
        second = case.place / "run_0002.mcap.part"  # written when all of the first is done
        wait_for(lambda: second.exists() and second.stat().st_size > 0, "the second part")
        shutil.rmtree(case.place)

    code, report, errors = case.run(harm, "--split-time", "1s")
    assert code == 1
    assert "went with the folder" in errors
    assert report["rescued"]
    for rescue in report["rescued"]:
        messages_of(Path(rescue))
