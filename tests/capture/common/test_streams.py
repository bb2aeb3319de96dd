"""Standard streams that are closed, or whose encoding lacks a character."""

import os
import subprocess

import pytest

from support.paths import ROOT
from support.processes import UNDULOG, python, undulog
from support.read_back import messages_of
from undulog import VERBS

ASCII = {"LC_ALL": "POSIX", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def closed(words, which, folder, **options):
    """Run a command with descriptors closed, by the shell as a user would."""
    shell = ["sh", "-c", f'exec "$@" {which}', "sh", *UNDULOG, *map(str, words)]
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    options = {"capture_output": True, "text": True, "timeout": 300} | options
    return subprocess.run(shell, cwd=folder, env=env, check=False, **options)


@pytest.mark.slow
@pytest.mark.parametrize("which", [">&-", "2>&-", "<&-", "<&- >&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(("words", "code"), [(("info",), 0), (("log", "info", "none.mcap"), 1)])
def test_a_command_with_closed_streams_ends_as_ever(which, words, code, tmp_path):
    done = closed(words, which, tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (code, False), done
    assert bool(done.stdout) == (">&-" not in which.replace("2>&-", "") and not code)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("which", [">&-", "<&- >&- 2>&-"])
def test_a_recorder_with_closed_streams_records_and_nothing_is_printed_into_it(which, tmp_path):
    words = ("record", "twin:flat", "--fast", "--duration", "1s", "--floor", "0")
    words += ("--socket", tmp_path / "c.sock", "-o", "run.mcap")
    done = closed(words, which, tmp_path)
    assert (done.returncode, "Traceback" in done.stderr) == (0, False)
    assert len(messages_of(tmp_path / "run.mcap")) > 1000
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


EVERY = """
import io, os, sys
import undulog
from undulog import VERBS

def child(verb, how, report):
    os.dup2(os.open(os.devnull, os.O_RDWR), 5)
    if how == "closed":
        for number in range(3):
            os.close(number)
        sys.stdin = sys.stdout = sys.stderr = None
    else:
        out = os.open(os.devnull, os.O_WRONLY)
        sys.stdout, sys.stderr = (io.TextIOWrapper(io.FileIO(out, "w"), "ascii") for _ in "12")
    sys.argv = ["undulog", *verb.split(), "--help"]
    try:
        undulog.main()
    except SystemExit as end:
        return end.code
    except BaseException as error:
        os.write(report, f"{verb} {how}: {error!r}\\n".encode())
        return 3

report = os.dup(1)
for verb in VERBS:
    for how in ("closed", "ascii"):
        pid = os.fork()
        if not pid:
            os._exit(child(verb, how, report))
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        if code:
            os.write(report, f"{verb} {how}: exit code {code}\\n".encode())
"""


@pytest.mark.nightly
def test_every_command_takes_closed_streams_and_an_encoding_of_ascii():
    assert len(VERBS) > 30
    done = python(EVERY, cwd=ROOT)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_what_an_encoding_lacks_is_escaped(tmp_path):
    name = "m\u00f6ve \u2603.mcap"
    (tmp_path / name).write_bytes(b"no log")
    env = os.environ | ASCII | {"PYTHONPATH": str(ROOT)}
    done = undulog("log", "info", name, cwd=tmp_path, env=env)
    assert done.returncode == 1
    assert done.stderr.isascii()
    assert "Traceback" not in done.stderr
    latin = env | {"PYTHONIOENCODING": "latin-1"}
    done = undulog("robot", "show", "\u2603", cwd=tmp_path, env=latin, encoding="latin-1")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)


def test_a_file_name_that_the_locale_lacks_is_an_error_with_its_fix(tmp_path):
    program = """
import os, sys, undulog
def fails(*_, **__):
    os.stat("\\u2603")
import undulog.capture.commands.info as info
info.info = fails
sys.exit(undulog.run(["info"]))
"""
    done = python(program, cwd=ROOT, env=os.environ | ASCII)
    assert done.returncode == 1, done
    assert "set LC_ALL=C.UTF-8" in done.stderr


def test_a_reader_that_has_seen_enough_ends_a_command_quietly(tmp_path):
    shell = f"{' '.join(UNDULOG)} sim show flat | head -n 1"
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        ["sh", "-c", shell], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr, done.stdout.count("\n")) == (0, "", 1)
