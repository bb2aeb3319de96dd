"""Tests of real time: marked ``clock(TOLERANCE_S, WHY)``, judged beside a witness.

They run after all others. A test that fails while the witness was later than the test's tolerance
says nothing of the product: it is run again, and after five such tries it ends as *not judged*,
which is no pass and no failure. ``WHY`` says what a simulated clock can't do here.

Any test that has processes of its own, and one among them that saw the computer late, raises
:class:`.witness.LateComputerError`: it is run again just so.
"""

import pytest
from _pytest.runner import runtestprotocol

from support.witness import LateComputerError, Witness

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


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(call):
    """Note in the report of a test what it saw of a late computer."""
    report = yield
    seen = call.excinfo is not None and call.excinfo.errisinstance(LateComputerError)
    report.late_computer = str(call.excinfo.value) if seen else ""
    return report


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    """Run a test as often as the computer was late for it."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    late = []
    while len(late) < TRIES:
        _begin_witness(item)
        reports = runtestprotocol(item, log=False, nextitem=nextitem)
        if not (seen := _late_for(item, reports)):
            break
        late.append(seen)
    else:
        _set_not_judged(item, reports, late)
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def _begin_witness(item):
    global _witness  # noqa: PLW0603
    if tolerance_of(item) is not None:
        _witness = _witness or Witness()
        _witness.late_s()


def _late_for(item, reports):
    """Return how the computer was too late for a test that failed; empty if it wasn't."""
    failed = [report for report in reports if report.failed]
    seen = [report.late_computer for report in failed]
    if seen and all(seen):  # what else failed is a failure
        return seen[0]
    if (tolerance_s := tolerance_of(item)) is None or not failed:
        return ""
    late_s = _witness.late_s()
    return f"{late_s:.3f} s, more than {tolerance_s:g} s" if late_s > tolerance_s else ""


def _set_not_judged(item, reports, late):
    why = f"not judged: this computer was late by {'; '.join(late)}"
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
