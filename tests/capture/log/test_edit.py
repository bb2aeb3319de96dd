"""Edits of logs, cut or merged: the same bytes each time, bounded memory, whole or not at all."""

import signal
import sys
import tracemalloc

import numpy as np
import pytest

from support.edited_logs import EPOCH_NS, MS, between, in_file_order, read, ticks, write_log
from support.foreign_logs import foreign_log
from support.processes import python, start
from undulog.capture.common.errors import UndulogError
from undulog.capture.common.process import StopRequest
from undulog.capture.log.cut import cut_log
from undulog.capture.log.merge import merge_logs

# -- both ------------------------------------------------------------------------------------


def test_the_same_edit_gives_the_same_bytes(tmp_path):
    logs = [write_log(tmp_path / f"{k}.mcap", ticks(50, topics=(f"/{k}",))) for k in range(2)]
    for k in range(2):
        cut_log(logs[0], tmp_path / f"cut{k}.mcap", stop_s=0.3)
        merge_logs(logs, tmp_path / f"both{k}.mcap")
    for name in ("cut", "both"):
        first, second = ((tmp_path / f"{name}{k}.mcap").read_bytes() for k in range(2))
        assert first == second


def test_a_topic_by_topic_log_is_edited_in_its_own_order(tmp_path):
    moments = [(f"/{x}", t * 10 * MS, f"{x} {t}" + "y" * 40) for x in "abc" for t in range(100)]
    whole = write_log(tmp_path / "whole.mcap", moments)
    cut_log(whole, tmp_path / "cut.mcap", start_s=0.2, stop_s=0.8)
    assert in_file_order(tmp_path / "cut.mcap") == between(in_file_order(whole), 200, 800)
    other = write_log(tmp_path / "other.mcap", ticks(50, topics=("/d",)))
    merge_logs([whole, other], tmp_path / "both.mcap")
    assert sorted(read(tmp_path / "both.mcap")) == sorted(read(whole) + read(other))


def test_memory_holds_a_few_chunks_however_long_the_log(tmp_path):
    logs = []
    for k in range(3):
        logs.append(tmp_path / f"{k}.mcap")
        with foreign_log(logs[-1], chunk_size=1 << 20) as (writer, schema):
            channel = writer.register_channel(f"/{k}", "cdr", schema)
            for tick in range(500):
                writer.add_message(channel, EPOCH_NS + tick * MS, bytes(1 << 16), 0)
    for edit, source, most in ((cut_log, logs[0], 10), (merge_logs, logs, 16)):  # of 31 and 94 MiB
        tracemalloc.start()
        edit(source, tmp_path / f"{most}.mcap")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < most << 20


def test_a_stop_leaves_nothing(tmp_path):
    logs = [write_log(tmp_path / f"{k}.mcap", ticks(20, topics=(f"/{k}",))) for k in range(2)]
    stop = StopRequest()
    stop.signal = signal.SIGTERM
    for edit, source in ((cut_log, logs[0]), (merge_logs, logs)):
        with pytest.raises(UndulogError, match="stopped by SIGTERM; nothing was written"):
            edit(source, tmp_path / "x.mcap", stop=stop)
    assert sorted(tmp_path.iterdir()) == logs


SLOW = """
import sys, time, undulog
from undulog.capture.log import edited_log as edit
write = edit.EditedLog.write
def slowly(*arguments):
    print("writing", flush=True)
    time.sleep(0.001)
    write(*arguments)
edit.EditedLog.write = slowly
sys.exit(undulog.run(sys.argv[1:]))
"""


def test_sigterm_leaves_no_half_file_and_the_former_one_whole(tmp_path):
    whole = write_log(tmp_path / "whole.mcap", ticks(5000))
    former = tmp_path / "cut.mcap"
    former.write_bytes(b"former")
    process = start(sys.executable, "-c", SLOW, "log", "cut", whole, "-o", former, "--force")
    assert process.stdout.readline() == "writing\n"
    assert (tmp_path / "cut.mcap.part").exists()
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate()
    assert (process.returncode, err) == (1, "error: stopped by SIGTERM; nothing was written\n")
    assert former.read_bytes() == b"former"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cut.mcap", "whole.mcap"]


def test_a_full_disk_is_reported_and_leaves_nothing(tmp_path):
    messages = [("/a", k * MS, np.random.default_rng(k).bytes(200).hex()) for k in range(200)]
    whole = write_log(tmp_path / "whole.mcap", messages)
    code = (
        "import resource, sys, undulog;"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096));"
        "sys.exit(undulog.run(sys.argv[1:]))"
    )
    done = python(code, "log", "cut", whole, "-o", tmp_path / "cut.mcap", code=1)
    assert "cut.mcap: can't be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == [whole]
