"""Part files: exclusive, never through a link, never another process's, never a recorder's."""

import os
import threading
from pathlib import Path

import pytest

from support.processes import python, python_started
from undulog.capture.common.console import refuse_existing
from undulog.capture.common.errors import LogWriteError, OutputExistsError
from undulog.capture.common.files import part_file, write_text
from undulog.capture.common.part_files import (
    claimed_part,
    is_recorders,
    publish,
    recording_left,
    stored_path,
    unfinished_path,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_an_output_appears_when_it_is_whole(tmp_path):
    output = tmp_path / "a.json"
    with part_file(output) as part:
        assert (part.name, part.read_bytes(), output.exists()) == ("a.json.part", b"", False)
        part.write_text("whole")
    assert (names(tmp_path), output.read_text()) == (["a.json"], "whole")


@pytest.mark.parametrize("durable", [False, True])
def test_a_failure_leaves_the_former_file_and_nothing_else(durable, tmp_path):
    output = tmp_path / "a.json"
    output.write_text("former")
    with pytest.raises(UnicodeEncodeError), part_file(output, durable=durable) as part:
        part.write_text("half \u00e9", encoding="ascii")
    assert (names(tmp_path), output.read_text()) == (["a.json"], "former")


def test_a_planted_link_is_not_written_through(tmp_path):
    victim, output = tmp_path / "victim", tmp_path / "a.json"
    victim.write_text("precious")
    unfinished_path(output).symlink_to(victim)
    write_text(output, "whole")
    assert (victim.read_text(), output.read_text()) == ("precious", "whole")
    assert unfinished_path(output).is_symlink()  # not ours to remove
    assert names(tmp_path) == ["a.json", "a.json.part", "victim"]


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_what_is_no_file_is_left_alone(kind, tmp_path):
    output = tmp_path / "a.json"
    part = unfinished_path(output)
    os.mkfifo(part) if kind == "fifo" else part.mkdir()
    write_text(output, "whole")
    assert (names(tmp_path), output.read_text()) == (["a.json", "a.json.part"], "whole")


def test_two_writers_of_one_output_have_files_of_their_own(tmp_path):
    output = tmp_path / "a.json"
    with part_file(output) as first, part_file(output) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert (names(tmp_path), output.read_text()) == (["a.json"], "first")


WRITER = """
import sys, time
from pathlib import Path
from undulog.capture.common.files import part_file
with part_file(Path(sys.argv[1])) as part:
    part.write_text("half")
    print("writing", flush=True)
    sys.stdin.read()
"""


def test_the_part_file_of_a_killed_command_is_replaced_and_that_of_a_living_one_is_not(tmp_path):
    output = tmp_path / "a.json"
    writer = python_started(WRITER, output, stdin=-1)
    try:
        assert writer.stdout.readline() == "writing\n"
        write_text(output, "whole")
        assert names(tmp_path) == ["a.json", "a.json.part"]
        assert unfinished_path(output).read_text() == "half"
    finally:
        writer.kill()
        writer.communicate()
    write_text(output, "again")
    assert (names(tmp_path), output.read_text()) == (["a.json"], "again")


MANY = """
import sys
from pathlib import Path
from undulog.capture.common.files import write_text
for _ in range(200):
    write_text(Path(sys.argv[1]), sys.argv[2] * 20_000)
"""


@pytest.mark.slow
def test_an_output_that_several_write_is_one_of_theirs_whole(tmp_path):
    output = tmp_path / "a.json"
    write_text(output, "a" * 20_000)
    writers = [python_started(MANY, output, letter) for letter in "abc"]
    wrong = 0
    while any(writer.poll() is None for writer in writers):
        text = output.read_text()
        wrong += len(text) != 20_000 or len(set(text)) != 1
    for writer in writers:
        assert writer.communicate() == ("", "")
        assert writer.returncode == 0
    assert (wrong, names(tmp_path)) == (0, ["a.json"])


def test_a_recorders_part_file_is_never_replaced(tmp_path):
    for name in ("run_0002.mcap", "run_mark0001.mcap", "run.mcap"):
        output = tmp_path / name
        unfinished_path(output).write_bytes(b"precious")
        if name == "run.mcap":
            assert not is_recorders(unfinished_path(output))
            output.with_name("run.mcap.wal").mkdir()
        assert recording_left(output) == unfinished_path(output)
        with pytest.raises(OutputExistsError, match=rf"{name}\.part exists already"):
            refuse_existing(output, force=False)
        write_text(output, "whole")
        assert unfinished_path(output).read_bytes() == b"precious"
        assert stored_path(output) == output
        output.unlink()
        assert stored_path(output) == unfinished_path(output)


@pytest.mark.parametrize("replace", [False, True])
def test_a_final_name_is_given_once(replace, tmp_path):
    part, output = tmp_path / "a.part", tmp_path / "a"
    part.write_text("new")
    output.write_text("old")
    if replace:
        publish(part, output, replace=True)
        assert (names(tmp_path), output.read_text()) == (["a"], "new")
        return
    with pytest.raises(FileExistsError):
        publish(part, output, replace=False)
    assert (part.read_text(), output.read_text()) == ("new", "old")
    output.unlink()
    publish(part, output, replace=False)
    assert (names(tmp_path), output.read_text()) == (["a"], "new")


def test_threads_that_claim_one_part_file_get_different_ones(tmp_path):
    taken, ready = [], threading.Barrier(8)

    def claim():
        ready.wait()
        with claimed_part(tmp_path / "a") as part:
            taken.append(part)
            ready.wait()

    threads = [threading.Thread(target=claim) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(set(taken)) == 8


def test_a_folder_that_is_gone_is_reported(tmp_path):
    with pytest.raises(LogWriteError, match="can't be written: No such file"):
        write_text(tmp_path / "none" / "a", "x")


def test_a_durable_output_is_synced_before_it_has_its_name(tmp_path):
    program = """
import os, sys
from pathlib import Path
from undulog.capture.common.files import part_file
done = []
for name in ("fsync", "replace"):
    def noted(*arguments, real=getattr(os, name), name=name):
        done.append(name)
        return real(*arguments)
    setattr(os, name, noted)
with part_file(Path(sys.argv[1]), durable=True) as part:
    part.write_text("x")
print(*done)
"""
    done = python(program, tmp_path / "a", code=0)
    assert done.stdout.split() == ["fsync", "replace", "fsync"]
    assert Path(tmp_path / "a").read_text() == "x"
