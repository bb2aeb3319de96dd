"""A run that goes on where another one stopped."""

import os
import sys

from support.paths import ROOT
from support.processes import run

TESTS = """
import os
import pytest

def test_good(): pass
def test_bad(): assert os.path.exists("mended")
@pytest.fixture
def broken():
    yield
    assert os.path.exists("mended")
def test_bad_teardown(broken): pass
@pytest.mark.parametrize("word", ["a b", "c"])
def test_words(word): pass
def test_skipped(): pytest.skip("not now")
"""


def test_what_passed_is_left_out_and_what_failed_is_run_again(tmp_path):
    (tmp_path / "test_some.py").write_text(TESTS)
    environment = {
        "PYTHONPATH": os.pathsep.join([str(ROOT / "tests"), str(ROOT)]),
        "UNDULOG_PASSED": str(tmp_path / "kept" / "passed.txt"),
    }
    words = ["-m", "pytest", "-q", "-p", "support.passed_tests", "-p", "no:cacheprovider", "."]

    def once():
        done = run(sys.executable, *words, cwd=tmp_path, env=os.environ | environment)
        return done.returncode, done.stdout.strip().splitlines()[-1]

    code, last = once()
    assert code == 1
    assert last.startswith("1 failed, 4 passed, 1 skipped, 1 error")
    (tmp_path / "mended").touch()
    code, last = once()
    assert code == 0
    assert last.startswith("2 passed, 1 skipped, 3 deselected")
    code, last = once()
    assert code == 0
    assert last.startswith("1 skipped, 5 deselected")
    (tmp_path / "test_some.py").write_text(TESTS.replace("def test_skipped", "def _skipped"))
    code, last = once()
    assert code == 0  # nothing is left to run
    assert last.startswith("5 deselected")
