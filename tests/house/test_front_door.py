"""The command line: every command has help with an example, and wrong words exit with 2."""

import json
import sys
from pathlib import Path

import pytest

import undulog
from support import processes
from support.paths import ROOT
from support.processes import python, run


@pytest.mark.parametrize("verb", sorted(undulog.VERBS))
def test_help_of_every_verb_shows_an_example(verb, command):
    shown = " ".join(command(*verb.split(), "--help").out.split())
    assert f"Usage: undulog {verb}" in shown
    assert f"Example: undulog {verb}" in shown


HELP_OF_EACH = """
import contextlib, io, json, sys, undulog
before, verbs = set(sys.modules), json.loads(sys.argv[1])
loaded = {}
for verb in verbs:
    with contextlib.redirect_stdout(io.StringIO()) as shown:
        undulog.run([*verb.split(), "--help"])
    assert "Usage: undulog" in shown.getvalue(), verb
    loaded[verb] = sorted({name.partition(".")[0] for name in set(sys.modules) - before})
    before |= set(sys.modules)
print(json.dumps(loaded))
"""
LAYOUT = {
    "attr",
    "attrs",
    "cyclopts",
    "docstring_parser",
    "markdown_it",
    "mdurl",
    "pygments",
    "rich",
}
"""Packages that parse a command line and lay out help."""


@pytest.mark.nightly
def test_no_help_imports_a_package_besides_those_that_lay_it_out():
    # Rerun reads its log level when it's loaded, so `view` has to be able to set it before.
    groups = {verb.split()[0] for verb in undulog.VERBS}
    verbs = ["", *sorted(groups | set(undulog.VERBS))]
    done = python(HELP_OF_EACH, json.dumps(verbs), code=0)
    allowed = LAYOUT | {"undulog"} | set(sys.stdlib_module_names)
    others = {verb: set(names) - allowed for verb, names in json.loads(done.stdout).items()}
    assert {verb: names for verb, names in others.items() if names} == {}


def test_help_lists_all_verbs(command):
    shown = command("--help").out
    for word in ("import", "log", "sim", "analyse", "report", "view", "info"):
        assert word in shown


def test_log_info_imports_no_package_that_opening_a_session_does_not_need(tmp_path):
    session = tmp_path / "small.mcap"
    with undulog.SessionWriter(session, session_id="small", epoch_ns=10**18) as writer:
        writer.joint_state("/joint_states", ["one"], unit="rad").write(10**18, [0.1])
    done = python(
        "import json, sys, undulog; undulog.run(['log', 'info', sys.argv[1]]);"
        "print(json.dumps(list(sys.modules)))",
        session,
    )
    *shown, loaded = done.stdout.splitlines()
    assert shown[0].startswith("small: no robot, 0.00 s"), done.stderr
    heavy = {
        "can",
        "cantools",
        "duckdb",
        "obstore",
        "pandas",
        "pyarrow",
        "rich",
        "rosbags",
        "scipy",
    }
    assert not heavy & set(json.loads(loaded))


def test_a_mistyped_verb_exits_2_and_names_the_near_one(command):
    err = command("analyze", "x.mcap", code=2).err
    assert "no command 'analyze'" in err
    assert "Did you mean 'analyse'?" in err


@pytest.mark.parametrize("words", [["--bogus"], ["-x", "analyse"], ["log", "--bogus"]])
def test_an_unknown_option_is_named_and_exits_2(words, command):
    option = next(word for word in words if word.startswith("-"))
    assert f"there is no option '{option}'" in command(*words, code=2).err


def test_a_missing_argument_exits_2(command):
    assert "FILE" in command("log", "info", code=2).err


@pytest.mark.nightly
def test_a_missing_extra_is_named():
    # None in sys.modules makes Python raise the same ImportError as a package that isn't there.
    code = (
        "import sys; sys.modules['pybullet'] = sys.modules['mujoco'] = None; import undulog;"
        "sys.exit(undulog.run(['sim', 'run', 'flat', '-o', 'never.mcap']))"
    )
    assert "the extra 'sim' brings it: pip install 'pybullet>=3.2.7'" in python(code, code=2).stderr


def test_info_names_versions(command):
    out = command("info").out
    assert "undulog 0" in out
    assert "numpy" in out


def test_a_closed_pipe_is_no_traceback():
    done = run("bash", "-c", f"{sys.executable} -m undulog info --json | true")
    assert "Traceback" not in done.stderr


@pytest.mark.nightly
def test_the_command_reads_mf4_though_it_defers_the_package(tmp_path):
    pytest.importorskip("asammdf", reason="the extra mf4 is not installed")
    trace, session = tmp_path / "trace.mf4", tmp_path / "trace.mcap"
    script = (
        "import can\n"
        f"with can.MF4Writer({str(trace)!r}) as writer:\n"
        "    for k in range(5):\n"
        "        writer.on_message_received(can.Message(timestamp=1.7e9 + k, arbitration_id=0x14B,"
        " is_extended_id=False, data=[k], channel=0))\n"
    )
    assert python(script).returncode == 0
    done = processes.undulog(
        "import", trace, "-o", session, "-r", "arcsnake-joint", cwd=ROOT, code=0
    )
    assert "5 CAN frames" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    ["--help", *(pytest.param(w, marks=pytest.mark.nightly) for w in ("info --json", "sim list"))],
)
def test_a_full_device_behind_the_output_is_an_error(words):
    with Path("/dev/full").open("w") as full:
        done = processes.undulog(*words.split(), cwd=ROOT, stdout=full)
        silent = processes.undulog(*words.split(), cwd=ROOT, stdout=full, stderr=full)
    assert (done.returncode, silent.returncode) == (1, 1)
    assert done.stderr == "error: the output can't be written: No space left on device\n"


@pytest.mark.slow
def test_reading_a_robot_loads_python_can_only_when_it_is_used():
    code = (
        "import sys; from undulog.capture.common.extras import defer; defer();"
        "from undulog.capture import load_robot; load_robot('snake25');"
        "assert 'cantools' in sys.modules; assert 'can' not in sys.modules;"
        "import cantools; assert issubclass(cantools.tester.Tester, object)"
    )
    python(code, code=0)
