"""The commands import and log export, as the command line calls them."""

import json
import signal

import pytest

from support.processes import UNDULOG, start, wait_for
from undulog.capture import Session

LOG = "".join(f"(100.{i:06d}) can0 {0x101 + i % 2:03X}#{i:02X}00 T\n" for i in range(10))


@pytest.fixture
def trace(tmp_path):
    (tmp_path / "trace.log").write_text(LOG)
    return tmp_path / "trace.log"


@pytest.fixture
def cli(trace, command):
    """Runs a line with {log} and {dir} to its exit code; returns output and errors."""

    def run(line, code=0):
        words = (word.format(log=trace, dir=trace.parent) for word in line.split())
        return command(*words, code=code)

    return run


def test_there_and_back(cli, tmp_path):
    run, back = tmp_path / "run.mcap", tmp_path / "back.log"
    lines = cli("import {log} -o {dir}/run.mcap --robot snake25").out.splitlines()
    assert lines[0] == f"{run}: 0.0 s of snake25, 10 CAN frames, verdict good"
    assert "  /joint_commands        5 messages" in lines
    done = f"{back}: 10 frames of can0, in the format of candump -L\n"
    assert cli("log export {dir}/run.mcap -o {dir}/back.log").out == done
    assert back.read_text() == LOG
    report = json.loads(cli("import {log} -o {dir}/run.mcap -r snake25 --force --json").out)
    assert (report["frames"], report["verdict"], report["robot"]) == (10, "good", "snake25")
    assert report["messages"]["/joint_commands"] == 5
    report = json.loads(cli("log export {dir}/run.mcap -o {dir}/back.log --force --json").out)
    paths = {"source": str(run), "output": str(back)}
    assert report == {**paths, "frames": 10, "buses": {"can0": 10}, "warnings": []}


def test_a_csv_by_options_and_by_file(cli, tmp_path, opened):
    (tmp_path / "joint.csv").write_text("time,angle\n0,170\n1,-170\n")
    common = "import {dir}/joint.csv --robot snake13"
    options = "--map time=time:s --map angle=joint01.position:deg,wrap=360"
    cli(f"{common} -o {{dir}}/a.mcap {options}")
    (tmp_path / "map.toml").write_bytes(opened(tmp_path / "a.mcap").attachments["columns.toml"])
    cli(common + " -o {dir}/b.mcap --columns {dir}/map.toml")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


WRONG = [
    (2, "{log} -o {dir}/x.mcap -r snak25", "did you mean snake25?"),
    (1, "{dir}/no.log -o {dir}/x.mcap -r snake25", "no.log: no such file"),
    (2, "{log} -o {log} -r snake25", "a session is an .mcap file, not .log"),
    (2, "{log} -o {dir}/no/x.mcap -r snake25", "no doesn't exist"),
    (1, "{dir}/a.csv -o {dir}/x.mcap -r snake25", "name them by --columns or --map"),
    (
        2,
        "{log} -o {dir}/x.mcap -r snake25 --map t=time:s",
        "holds CAN frames; --map: for logs of another kind",
    ),
    (1, "{dir}/bad.log -o {dir}/x.mcap -r snake25", "is not a candump log"),
    (1, "{log} -o {dir}/x.mcap -r snake25 --bus can7", "has no frames of bus can7; it has can0"),
]


@pytest.mark.parametrize(("code", "line", "message"), WRONG)
def test_what_is_wrong_is_reported(code, line, message, cli, tmp_path):
    (tmp_path / "a.csv").write_text("t,a\n0,1\n")
    (tmp_path / "bad.log").write_text("no log\n")
    out, err = cli(f"import {line}", code)
    assert out == ""
    assert message in err
    assert not (tmp_path / "x.mcap").exists()


def test_an_output_is_kept_without_force(cli):
    line = "import {log} -o {dir}/run.mcap --robot snake25"
    cli(line)
    refused = "run.mcap exists already; choose another name or give --force"
    assert refused in cli(line, 2).err
    cli(f"{line} --force")


@pytest.mark.parametrize(
    ("code", "line", "message"),
    [
        (2, "{dir}/run.mcap -o {dir}/x.trc", "no format has the suffix '.trc'; valid: .log, .blf"),
        (1, "{dir}/run.mcap -o {dir}/x.log --bus b", "has no bus b; it has can0"),
        (1, "{dir}/csv.mcap -o x.log", "has no raw CAN frames; it has /joint_states"),
    ],
)
def test_what_export_cannot_do_is_reported(code, line, message, cli, tmp_path):
    (tmp_path / "a.csv").write_text("t,a\n0,1\n")
    columns = "--map t=time:s --map a=joint01.position:rad"
    cli("import {log} -o {dir}/run.mcap --robot snake25")
    cli("import {dir}/a.csv -o {dir}/csv.mcap --robot snake13 " + columns)
    assert message in cli(f"log export {line}", code).err


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.nightly)]
)
def test_a_signal_leaves_a_whole_file(number, tmp_path):
    trace, run = tmp_path / "trace.log", tmp_path / "run.mcap"
    lines = (
        f"({100 + i // 1000}.{i % 1000 * 1000:06d}) can0 101#0000 T\n" for i in range(1_500_000)
    )
    trace.write_text("".join(lines))
    process = start(*UNDULOG, "import", trace, "-o", run, "--robot", "snake25")
    part = tmp_path / "run.mcap.part"
    wait_for(lambda: part.exists() and part.stat().st_size > 1_000_000, alive=[process])
    process.send_signal(number)
    out, _ = process.communicate()
    assert process.returncode == 1
    assert "stopped on request; the file is complete up to there" in out
    with Session.open(run) as session:
        assert session.warnings == []
        assert 0 < len(session.frames("/can/can0")) < 1_500_000
    assert not part.exists()
