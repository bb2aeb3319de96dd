"""What ``make nightly`` makes of its parts."""

import json
import signal
import subprocess
import sys

import pytest

from support.paths import ROOT
from support.processes import run, start, wait_for

PARTS = """
import nightly
nightly.FOLDER = nightly.Path({folder!r})
nightly.LIMIT_S = 1.0
nightly.PARTS = {{
    "good": nightly.Part("echo x >> {folder}/ran; echo fine", "one"),
    "bad": nightly.Part("echo it broke; exit 3", "two"),
    "long": nightly.Part("sleep 600", "three"),
    "longer": nightly.Part("sleep 600", "four", resumes=True),
}}
raise SystemExit(nightly.main())
"""


@pytest.fixture
def night(tmp_path):
    """Runs four parts of its own; returns the exit code and the rows of the table."""

    def of(*names):
        program = PARTS.format(folder=str(tmp_path))
        done = run(sys.executable, "-c", program, *names, cwd=ROOT / ".ci")
        rows = [line.split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
        return done.returncode, {row[0].strip("| "): row[2] for row in rows[1:]}

    return of


@pytest.mark.slow
def test_each_part_has_an_outcome_and_what_passed_is_not_run_again(night, tmp_path):
    code, states = night()
    expected = {"good": "passed", "bad": "failed", "long": "limit", "longer": "goes on"}
    assert (code, states) == (1, expected)
    assert night("good") == (0, expected)
    assert (tmp_path / "ran").read_text() == "x\n"
    (only,) = json.loads((tmp_path / "outcomes.json").read_text()).values()
    assert only["good"]["last"] == "fine"
    kept = {"0123456789ab": only}  # of another commit
    (tmp_path / "outcomes.json").write_text(json.dumps(kept))
    assert night("good")[1] == {**dict.fromkeys(expected, "not run"), "good": "passed"}
    assert (tmp_path / "ran").read_text() == "x\nx\n"


def test_an_interrupt_ends_the_part_and_leaves_the_table(tmp_path):
    program = PARTS.format(folder=str(tmp_path)).replace("= 1.0", "= 600.0")
    words = [sys.executable, "-c", program, "long"]
    with start(*words, cwd=ROOT / ".ci", stdin=subprocess.DEVNULL) as night:
        wait_for((tmp_path / "long.log").exists, "the part", alive=[night])
        night.send_signal(signal.SIGINT)
        out, _ = night.communicate()
    assert night.returncode == 1
    assert "interrupted" in out
    assert "| long | three | not run |" in out


def test_a_part_that_there_is_not_is_named():
    done = run(sys.executable, ".ci/nightly.py", "zo", cwd=ROOT, code=2)
    assert "no part zo; there are slow, clock, delays, night" in done.stderr
