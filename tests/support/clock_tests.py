"""Tests of real time: marked ``clock(TOLERANCE_S, WHY)``, judged beside a witness.

They run after all others. A test that fails while the witness was later than the test's tolerance
says nothing of the product: it is run again, and after five such tries it ends as *not judged*,
which is no pass and no failure. ``WHY`` says what a simulated clock can't do here.
"""

import pytest
from _pytest.runner import runtestprotocol

from support.witness import Witness

TRIES = 5
_witness = None


def tolerance_of(item):
    """Return the tolerance of a test of real time [s]; None for any other test."""
    marker = item.get_closest_marker("clock")
    if marker is None:
        return None
    tolerance_s, why = marker.args
    assert tolerance_s > 0
    assert why
    return tolerance_s


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Run tests of real time last."""
    items.sort(key=lambda item: tolerance_of(item) is not None)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Run a test of real time as often as the witness says that the computer was late."""
    global _witness  # noqa: PLW0603
    tolerance_s = tolerance_of(item)
    if tolerance_s is None:
        return None
    _witness = _witness or Witness()
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    late_s = []
    while len(late_s) < TRIES:
        _witness.late_s()
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        late_s.append(_witness.late_s())
        if not any(report.failed for report in reports) or late_s[-1] <= tolerance_s:
            break
    else:
        _set_not_judged(item, reports, late_s, tolerance_s)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def _set_not_judged(item, reports, late_s, tolerance_s):
    late = ", ".join(f"{one:.3f}" for one in late_s)
    why = f"not judged: this computer was late by {late} s, more than {tolerance_s:g} s"
    path, line, _ = item.location
    for report in reports:
        if report.failed:
            report.outcome, report.longrepr = "skipped", (path, line or 0, why)
            report.not_judged = why


def pytest_report_teststatus(report):
    """Give tests that were not judged a column of their own."""
    if getattr(report, "not_judged", ""):
        return "not judged", "N", "NOT JUDGED"
    return None


def pytest_terminal_summary(terminalreporter):
    """List tests that were not judged."""
    for report in terminalreporter.stats.get("not judged", ()):
        terminalreporter.write_line(f"NOT JUDGED {report.nodeid}: {report.not_judged}")


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish():
    """End the witness."""
    if _witness is not None:
        _witness.close()
