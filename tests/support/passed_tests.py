"""A long run that goes on where it was: tests that a file lists as passed are left out.

``UNDULOG_PASSED=FILE pytest ...`` writes the name of each test that passes to FILE, and runs none
that is listed there; one that is skipped or not judged is run again. Several runs may share the
file.
"""

import os
from pathlib import Path

import pytest

PASSED = "UNDULOG_PASSED"
"""Environment variable: the file."""
LEFT_OUT = pytest.StashKey[int]()
REPORTS = pytest.StashKey[list[pytest.TestReport]]()


def _file():
    name = os.environ.get(PASSED)
    return Path(name).absolute() if name else None


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    """Leave out what is listed."""
    path = _file()
    if path is None or not path.exists():
        return
    passed = set(path.read_text().splitlines())
    left_out = [item for item in items if item.nodeid in passed]
    items[:] = [item for item in items if item.nodeid not in passed]
    config.hook.pytest_deselected(items=left_out)
    config.stash[LEFT_OUT] = len(left_out)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    """List a test when its teardown, too, has passed."""
    item.stash[REPORTS] = []
    result = yield
    path = _file()
    if path is not None and all(report.passed for report in item.stash[REPORTS]):
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a") as listed:  # short lines: several processes append whole ones
            listed.write(f"{item.nodeid}\n")
    return result


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item):
    """Keep what became of set-up, call and teardown."""
    report = yield
    item.stash[REPORTS].append(report)
    return report


def pytest_sessionfinish(session, exitstatus):
    """A run of which all tests are listed has passed."""
    if exitstatus == pytest.ExitCode.NO_TESTS_COLLECTED and session.config.stash.get(LEFT_OUT, 0):
        session.exitstatus = pytest.ExitCode.OK
