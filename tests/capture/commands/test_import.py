"""The commands import and log export, as the command line calls them."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import undulog
from undulog.capture import Session

LOG = "".join(f"(100.{i:06d}) can0 {0x101 + i % 2:03X}#{i:02X}00 T\n" for i in range(10))


@pytest.fixture
def trace(tmp_path: Path):
    path = tmp_path / "trace.log"
    path.write_text(LOG)
    return path


def test_there_and_back(trace, tmp_path: Path, capsys):
    run, back = tmp_path / "run.mcap", tmp_path / "back.log"
    assert undulog.run(["import", str(trace), "-o", str(run), "--robot", "snake25"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{run}: 0.0 s of snake25, 10 CAN frames, verdict good"
    assert "  /joint_commands        5 messages" in lines
    assert undulog.run(["log", "export", str(run), "-o", str(back)]) == 0
    assert capsys.readouterr().out == f"{back}: 10 frames of can0, in the format of candump -L\n"
    assert back.read_text() == LOG


def test_reports_as_json(trace, tmp_path: Path, capsys):
    run = tmp_path / "run.mcap"
    arguments = ["import", str(trace), "-o", str(run), "--robot", "snake25", "--json"]
    assert undulog.run(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["frames"], report["verdict"], report["robot"]) == (10, "good", "snake25")
    assert report["messages"]["/joint_commands"] == 5
    back = str(tmp_path / "back.log")
    assert undulog.run(["log", "export", str(run), "-o", back, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "source": str(run),
        "output": back,
        "frames": 10,
        "buses": {"can0": 10},
        "warnings": [],
    }


def test_a_csv_by_options_and_by_file(tmp_path: Path, capsys):
    source = tmp_path / "joint.csv"
    source.write_text("time,angle\n0,170\n1,-170\n")
    options = ["--map", "time=time:s", "--map", "angle=joint01.position:deg,wrap=360"]
    common = ["import", str(source), "--robot", "snake13"]
    assert undulog.run([*common, "-o", str(tmp_path / "a.mcap"), *options]) == 0
    with Session.open(tmp_path / "a.mcap") as session:
        (tmp_path / "map.toml").write_bytes(session.attachments["columns.toml"])
    columns = ["--columns", str(tmp_path / "map.toml")]
    assert undulog.run([*common, "-o", str(tmp_path / "b.mcap"), *columns]) == 0
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    capsys.readouterr()


WRONG = [
    (2, "{log} -o {dir}/x.mcap -r snak25", "did you mean snake25?"),
    (1, "{dir}/no.log -o {dir}/x.mcap -r snake25", "no.log: no such file"),
    (2, "{log} -o {log} -r snake25", "a session is an .mcap file, not .log"),
    (2, "{log} -o {dir}/no/x.mcap -r snake25", "no doesn't exist"),
    (2, "{dir}/a.csv -o {dir}/x.mcap -r snake25", "needs --columns MAP.toml or --map options"),
    (2, "{log} -o {dir}/x.mcap -r snake25 --map t=time:s", "--map are for other CSV logs"),
    (1, "{dir}/bad.log -o {dir}/x.mcap -r snake25", "is not a candump log"),
    (1, "{log} -o {dir}/x.mcap -r snake25 --bus can7", "has no frames of bus can7; it has can0"),
]


@pytest.mark.parametrize(("code", "line", "message"), WRONG)
def test_what_is_wrong_is_said(code, line, message, trace, capsys):
    folder = trace.parent
    (folder / "a.csv").write_text("t,a\n0,1\n")
    (folder / "bad.log").write_text("no log\n")
    arguments = [word.format(log=trace, dir=folder) for word in line.split()]
    assert undulog.run(["import", *arguments]) == code
    said = capsys.readouterr()
    assert said.out == ""
    assert message in said.err
    assert not (folder / "x.mcap").exists()


def test_what_is_there_is_kept_without_force(trace, tmp_path: Path, capsys):
    run = tmp_path / "run.mcap"
    arguments = ["import", str(trace), "-o", str(run), "--robot", "snake25"]
    assert [undulog.run(arguments), undulog.run(arguments)] == [0, 2]
    assert "run.mcap exists already; choose another name or give --force" in capsys.readouterr().err
    assert undulog.run([*arguments, "--force"]) == 0
    back = tmp_path / "back.log"
    back.write_text("precious")
    assert undulog.run(["log", "export", str(run), "-o", str(back)]) == 2
    assert back.read_text() == "precious"


def test_what_export_cannot_do_is_said(trace, tmp_path: Path, capsys):
    run = tmp_path / "run.mcap"
    undulog.run(["import", str(trace), "-o", str(run), "--robot", "snake25"])
    capsys.readouterr()
    assert undulog.run(["log", "export", str(run), "-o", str(tmp_path / "x.trc")]) == 2
    assert "no format has the suffix '.trc'; valid: .log, .blf" in capsys.readouterr().err
    assert (
        undulog.run(["log", "export", str(run), "-o", str(tmp_path / "x.log"), "--bus", "b"]) == 1
    )
    assert "has no bus b; it has can0" in capsys.readouterr().err
    source = tmp_path / "a.csv"
    source.write_text("t,a\n0,1\n")
    options = ["--map", "t=time:s", "--map", "a=joint01.position:rad"]
    arguments = ["import", str(source), "-o", str(tmp_path / "csv.mcap"), "--robot", "snake13"]
    undulog.run([*arguments, *options])
    capsys.readouterr()
    assert undulog.run(["log", "export", str(tmp_path / "csv.mcap"), "-o", "x.log"]) == 1
    assert "has no raw CAN frames; it has /joint_states" in capsys.readouterr().err


def test_help_shows_an_example(capsys):
    for verb in (["import"], ["log", "export"]):
        undulog.run([*verb, "--help"])
        assert f"Example: undulog {' '.join(verb)}" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_a_whole_file(number, tmp_path: Path):
    trace, run = tmp_path / "trace.log", tmp_path / "run.mcap"
    with trace.open("w") as stream:
        for i in range(1_500_000):
            stream.write(f"({100 + i // 1000}.{i % 1000 * 1000:06d}) can0 101#0000 T\n")
    arguments = ["import", str(trace), "-o", str(run), "--robot", "snake25"]
    process = subprocess.Popen(
        [sys.executable, "-m", "undulog", *arguments], stdout=subprocess.PIPE, text=True
    )
    part = tmp_path / "run.mcap.part"
    while process.poll() is None and not (part.exists() and part.stat().st_size > 1_000_000):
        time.sleep(0.05)
    os.kill(process.pid, number)
    out, _ = process.communicate()
    assert process.returncode == 1
    assert "stopped on request; the file is complete up to there" in out
    with Session.open(run) as session:
        assert session.warnings == []
        assert 0 < len(session.frames("/can/can0")) < 1_500_000
    assert not part.exists()
