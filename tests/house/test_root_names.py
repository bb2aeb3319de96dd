"""The names of ``import undulog``: imported when used, typed, and paths in, results out."""

import inspect
import os
import re
import sys
import textwrap
import time
import venv
import zipfile
from pathlib import Path

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import undulog
from support import processes
from support.paths import ROOT
from support.processes import python
from undulog.capture.common.errors import UsageError

STRANGER = """
import undulog
from undulog.capture import SessionWriter

scenario = undulog.load_scenario("flat").changed(duration_s=2.0)
recording = undulog.record(scenario, "run.mcap", force=True)
result = undulog.analyse("run.mcap")
several = undulog.analyse("run.mcap", "run.mcap")
reveal_type(result)
reveal_type(several)
reveal_type(undulog.compare("a.mcap", ["b.mcap", "c.mcap"]))
with undulog.Session.open("run.mcap") as session:
    reveal_type(session.joints("/joint_states", "position").values)
    reveal_type(undulog.analyse(session).joints[0].gain)
with undulog.Twin(scenario) as twin:
    for sample in twin.samples():
        reveal_type(sample.time_s)
        break
print(recording.path, result.frames()["joints"], SessionWriter)
undulog.analyse(3)
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, changes in (("a", {}), ("b", {"servo.stall_torque": 0.3})):
        undulog.record("flat", folder / f"{name}.mcap", changes=changes, duration_s=8.0)
    return folder


def test_importing_undulog_imports_none_of_its_packages():
    code = (
        "import sys; before = set(sys.modules); import undulog;"
        "print(*sorted(n for n in set(sys.modules) - before if 'undulog' in n or 'numpy' in n))"
    )
    assert python(code).stdout.split() == ["undulog"]


def test_every_name_can_be_imported_and_no_other():
    assert all(getattr(undulog, name) is not None for name in undulog.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        undulog.nothing  # noqa: B018
    homes = [name for names in undulog._HOMES.values() for name in names.split()]
    assert sorted([*homes, "run"]) == undulog.__all__


@pytest.mark.nightly
def test_paths_and_open_sessions_give_the_same(runs):
    single = undulog.analyse(runs / "a.mcap")
    with undulog.Session.open(runs / "a.mcap") as session:
        again = undulog.analyse(session)
        assert session.duration_s == pytest.approx(8.0, abs=0.1)
    assert single.joints == again.joints
    several = undulog.analyse(runs / "a.mcap", str(runs / "b.mcap"))
    assert isinstance(several, undulog.Experiment)
    comparison = undulog.compare(runs / "a.mcap", [runs / "b.mcap"])
    assert "servo.stall_torque" in str(comparison)
    for result in (single, several, comparison):
        assert "<table" in result._repr_html_()


def test_changes_are_for_a_scenario_that_is_named(tmp_path):
    with pytest.raises(UsageError, match="changes are for"):
        undulog.record(undulog.load_scenario("flat"), tmp_path / "x.mcap", changes={"seed": 2})


@pytest.mark.nightly
def test_a_strangers_program_is_typed_by_the_installed_wheel(tmp_path):
    build = (sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path)
    assert processes.run(*build, cwd=ROOT).returncode == 0
    venv.create(tmp_path / "venv", with_pip=False)
    (site,) = (tmp_path / "venv/lib").glob("python*/site-packages")
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        wheel.extractall(site)
    (ours,) = {Path(p) for p in sys.path if p.endswith("site-packages")}
    (site / "dependencies.pth").write_text(f"{ours}\n")
    (tmp_path / "stranger.py").write_text(STRANGER)
    check = (sys.executable, "-m", "pyright", "--pythonpath", tmp_path / "venv/bin/python")
    output = processes.run(*check, "stranger.py", cwd=tmp_path).stdout
    types = {line.rpartition(" is ")[2] for line in output.splitlines() if "information:" in line}
    assert {'"Analysis"', '"Experiment"', '"Comparison"', '"Estimate"'} <= types, output
    assert not [shown for shown in types if "Unknown" in shown], output
    errors = [line for line in output.splitlines() if " error: " in line]
    assert len(errors) == 1, output
    assert "stranger.py:20:" in errors[0]


THREADS = """
import os, sys, undulog
sys.argv = ["undulog", "--version"]
try:
    undulog.main()
except SystemExit:
    import numpy
    print(len(os.listdir("/proc/self/task")))
"""


def threads_of_numpy(**environment):
    inherited = {key: value for key, value in os.environ.items() if "NUM_THREADS" not in key}
    return int(python(THREADS, env=inherited | environment, code=0).stdout.split()[-1])


@pytest.mark.skipif(os.cpu_count() == 1, reason="there is one core")
def test_the_command_has_one_thread_of_linear_algebra_unless_told():
    """More wait for each other: on a busy machine ``analyse`` took four times as long."""
    assert threads_of_numpy() == 1
    assert threads_of_numpy(OPENBLAS_NUM_THREADS="2") == 2


@pytest.mark.nightly
def test_a_notebook_has_one_thread_of_linear_algebra_while_it_analyses(runs, monkeypatch):
    seen, analyse_session = [], undulog.analysis.analyse_session

    def watched(*args):
        seen.extend(
            library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
        )
        return analyse_session(*args)

    monkeypatch.setattr("undulog.analysis.analyse_session", watched)
    with threadpool_limits(2, "blas"):
        before = [library["num_threads"] for library in threadpool_info()]
        undulog.analyse(runs / "a.mcap")
        assert [library["num_threads"] for library in threadpool_info()] == before
    assert seen
    assert set(seen) == {1}


@pytest.mark.slow
def test_every_name_has_an_example_that_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = ["record", "load_scenario", "load_robot"]  # others read what these make
    for name in [*first, *sorted(set(undulog.__all__) - {*first})]:
        value = getattr(undulog, name)
        documentation = inspect.getdoc(value)
        if inspect.isfunction(value):
            assert {"Args:", "Returns:"} <= set(documentation.split()), name
            arguments = re.findall(r"^    (\w+): ", documentation, re.MULTILINE)
            assert set(inspect.signature(value).parameters) <= {*arguments}, name
        example = documentation.partition("Example::\n")[2]
        lines = re.match(r"(?:(?: {4}.*)?\n|(?: {4}.*)$)*", example)[0]
        assert lines.strip(), name
        exec(textwrap.dedent(lines), {"undulog": undulog, "Path": Path, "time": time})
    assert dir(undulog) == sorted(undulog.__all__)
