"""The format of the manual, in a package of its own: imported and exported by the command line."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from support.paths import ROOT
from undulog.capture import Session

PAGE = (ROOT / "docs/reference/formats.md").read_text()
CODE = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)[1]
POINT = 'bench = "undulog_bench:FORMAT"'
TIMES = [f"17000000{k:02d}.000000123" for k in range(20)]
ANGLES = np.sin(np.arange(20.0))


def package(folder, code=CODE, point=POINT):
    """Lay out what an installed package is."""
    info = folder / "undulog_bench-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "undulog_bench.py").write_text(code)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: undulog-bench\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[undulog.formats]\n{point.replace(chr(34), '')}\n")
    return folder


def run(*words, packages, code=0):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *map(str, packages)])}
    result = subprocess.run(
        [sys.executable, "-m", "undulog", *map(str, words)],
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert result.returncode == code, result.stderr
    return result.stdout if code == 0 else result.stderr


@pytest.fixture
def log(tmp_path):
    rows = [f"{t}|{angle!r}" for t, angle in zip(TIMES, ANGLES.tolist(), strict=True)]
    path = tmp_path / "run.bench"
    path.write_text("\n".join(["BENCH 1", "time [s]|joint1.position [rad]", *rows, ""]))
    return path


def test_it_takes_about_forty_lines():
    assert len([line for line in CODE.splitlines() if line.strip()]) <= 44


def test_it_is_found_by_suffix_and_by_content_and_written(log, tmp_path):
    packages = [package(tmp_path / "format")]
    session, other = tmp_path / "run.mcap", tmp_path / "other.mcap"
    renamed = log.with_suffix(".dat")
    renamed.write_bytes(log.read_bytes())
    run("import", log, "-o", session, packages=packages)
    run("import", renamed, "-o", other, packages=packages)
    for path in (session, other):
        with Session.open(path) as opened:
            signal = opened.joints("/joint_states").signal("joint1")
            np.testing.assert_array_equal(signal.values, ANGLES)
            assert signal.t_ns.tolist() == [int(t.replace(".", "")) for t in TIMES]
    for layout in ([], ["--to", "wide"]):
        back = tmp_path / f"back{len(layout)}.bench"
        run("log", "export", session, *layout, "-o", back, packages=packages)
        assert back.read_text().startswith("BENCH 1\nt_ns|")
    again = tmp_path / "again.mcap"
    run("import", tmp_path / "back2.bench", "-o", again, packages=packages)
    with Session.open(again) as opened:
        signal = opened.joints("/joint_states").signal("joint1")
        np.testing.assert_array_equal(signal.values, ANGLES)
        assert signal.t_ns.tolist() == [int(t.replace(".", "")) for t in TIMES]


def test_a_file_beside_the_others_is_enough(log, tmp_path):
    """A format of undulog itself is found in its file: nothing else names it."""
    (tmp_path / "more").mkdir()
    (tmp_path / "more/bench.py").write_text(CODE)
    (tmp_path / "sitecustomize.py").write_text(
        "import undulog.capture.exchange.formats as formats\n"
        f"formats.__path__.append({str(tmp_path / 'more')!r})\n"
    )
    run("import", log, "-o", tmp_path / "run.mcap", packages=[tmp_path])
    with Session.open(tmp_path / "run.mcap") as opened:
        signal = opened.joints("/joint_states").signal("joint1")
        np.testing.assert_array_equal(signal.values, ANGLES)


def test_without_the_package_the_file_is_of_no_format(log, tmp_path):
    refused = run("import", log, "-o", tmp_path / "x.mcap", packages=[], code=1)
    assert "run.bench: is of no format that can be imported: it looks like text" in refused
    assert "'BENCH 1'" in refused
    output = run("log", "export", log, "-o", tmp_path / "x.bench", packages=[], code=2)
    assert "no format has the suffix '.bench'" in output


def test_what_is_wrong_with_a_file_is_its_own_words(log, tmp_path):
    log.write_text("BENCH 2\n")
    refused = run(
        "import", log, "-o", tmp_path / "x.mcap", packages=[package(tmp_path / "f")], code=1
    )
    assert "is no log of the bench: it doesn't begin with 'BENCH 1" in refused


UNUSABLE = {
    "no format": ("FORMAT = 3\n", POINT, "is no undulog.capture.exchange.formats.format.Format"),
    "no import": ("import nowhere\n", POINT, "can't be loaded: No module named 'nowhere'"),
    "name taken": (
        CODE.replace('"bench", "log', '"csv", "log'),
        'csv = "undulog_bench:FORMAT"',
        "the format 'csv' (undulog_bench:FORMAT) has a name that is taken",
    ),
    "other name": (CODE, 'other = "undulog_bench:FORMAT"', "its 'name' has to be that of its"),
    "title": (CODE.replace('"log of the bench"', "None"), POINT, "its 'title' has to be a text"),
    "suffixes": (CODE.replace('(".bench",)', '".bench"'), POINT, "its 'suffixes' have to be"),
    "capital": (CODE.replace('(".bench",)', '(".BENCH",)'), POINT, "in small letters"),
    "sniff": (
        CODE.replace('(".bench",), sniff', '(".bench",), 0.5'),
        POINT,
        "its 'sniff' has to be",
    ),
    "read": (CODE.replace("TableReader(read)", "read"), POINT, "its 'read' has to be a reader"),
    "write": (CODE.replace("TableWriter(write)", "write"), POINT, "its 'write' has to be a wri"),
    "neither": (
        CODE.replace(", TableReader(read), TableWriter(write)", ""),
        POINT,
        "it needs 'read' or 'write'",
    ),
}
FAILING = {
    "sniff": (
        CODE.replace("return float(head", "return 1 / 0 + float(head"),
        "run.bench: the format 'bench' failed",
    ),
    "read": (CODE.replace("names = stream", "1 / 0; names = stream"), "the format 'bench' failed"),
    "blocks": (CODE.replace("exact = {time", "1 / 0; exact = {time"), "the format 'bench' failed"),
}


@pytest.mark.parametrize(("code", "point", "message"), list(UNUSABLE.values()), ids=UNUSABLE)
def test_a_format_that_can_not_be_used_is_named(code, point, message, log, tmp_path):
    assert (code, point) != (CODE, POINT)
    packages = [package(tmp_path / "format", code, point)]
    trouble = run("import", log, "-o", tmp_path / "x.mcap", packages=packages, code=2)
    assert message in trouble
    assert "undulog_bench:FORMAT" in trouble
    assert "Traceback" not in trouble


@pytest.mark.parametrize(("code", "message"), list(FAILING.values()), ids=FAILING)
def test_a_format_that_fails_is_named(code, message, log, tmp_path):
    assert code != CODE
    packages = [package(tmp_path / "format", code)]
    trouble = run("import", log, "-o", tmp_path / "x.mcap", packages=packages, code=1)
    assert message in trouble
    assert "ZeroDivisionError" in trouble
    assert "Traceback" not in trouble


def test_a_writer_that_fails_is_named_and_leaves_nothing(log, tmp_path):
    session, output = tmp_path / "run.mcap", tmp_path / "x.bench"
    run("import", log, "-o", session, packages=[package(tmp_path / "whole")])
    packages = [
        package(tmp_path / "format", CODE.replace("for row in zip", "for row in 1 / 0, zip"))
    ]
    trouble = run("log", "export", session, "-o", output, packages=packages, code=1)
    assert "x.bench: the format 'bench' failed: ZeroDivisionError" in trouble
    assert "Traceback" not in trouble
    assert not list(tmp_path.glob("x.bench*"))
