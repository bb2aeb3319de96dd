"""Delays: ``make delays``. Is a product that is late found by the tests of real time?

A delay of twice a test's tolerance is planted where the test would feel it; the test has to fail
each time. For a computer that does nothing else: a test that isn't judged has not failed.

``test_gate_stall.py`` isn't among them: commands stay within their bound however late the product
is, and the stalls and delays of those tests are their own inputs.
"""

import argparse
import ast
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from support.paths import ROOT

from .run import Tree


@dataclass(frozen=True)
class Delay:
    """A place for a delay, and the test that has to find it.

    Attributes:
        test: Its file and function.
        path: The module of the product.
        old: What stands there, once.
        new: What is put there; ``{s}`` and ``{ns}`` are the delay [s], [ns].
    """

    test: str
    path: str
    old: str
    new: str


SLEEP = "__import__('time').sleep({s})"
ARRIVALS = '        frames["t_host_ns"] = np.repeat(np.array(arrivals, dtype=np.uint64), counts)\n'
LATER = ARRIVALS + '        frames["t_host_ns"] += np.uint64({ns} * (self.counts.frames > 4000))\n'
RECORDER = "tests/capture/recorder"
DELAYS = [
    Delay(
        f"{RECORDER}/test_record_kill.py::test_a_killed_recording_has_what_was_accepted",
        "capture/recorder/loop.py",
        "            polled = self._asked(source)\n",
        f"            polled = self._asked(source)\n            {SLEEP}\n",
    ),
    Delay(
        f"{RECORDER}/test_record_pauses.py"
        "::test_frames_that_waited_during_a_stop_have_the_time_of_their_arrival",
        "capture/sources/unix_socket.py",
        ARRIVALS,
        ARRIVALS + '        frames["t_host_ns"] += np.uint64({ns})\n',
    ),
    Delay(
        f"{RECORDER}/test_record_health.py"
        "::test_what_is_stored_is_what_a_check_finds_and_what_was_done",
        "capture/sources/unix_socket.py",
        ARRIVALS,
        LATER,
    ),
    Delay(
        f"{RECORDER}/test_record.py"
        "::test_a_wall_clock_that_is_set_changes_no_order_and_no_duration",
        "capture/sources/unix_socket.py",
        ARRIVALS,
        LATER,
    ),
    Delay(
        f"{RECORDER}/test_source_clock.py"
        "::test_another_process_with_another_clock_over_a_real_socket",
        "capture/recorder/source_clock.py",
        "            self._count_delays()\n        return mapped\n",
        "            self._count_delays()\n        return mapped + {ns}\n",
    ),
    Delay(
        "tests/capture/exchange/test_can_fd.py::test_a_recording_keeps_and_decodes_both_kinds",
        "capture/sources/can.py",
        "[given] = micros * np.uint64(1000)\n",
        "[given] = micros * np.uint64(1000) + np.uint64({ns} * fd)\n",
    ),
    Delay(
        "tests/sim/serve/test_feetech.py"
        "::test_the_vendors_sdk_drives_it_and_a_second_adapter_records_it",
        "sim/serve/feetech.py",
        "            if answer:\n",
        f"            if answer:\n                {SLEEP}\n",
    ),
    Delay(
        "tests/sim/serve/test_robot.py::test_it_waits_for_the_first_command_and_then_keeps_time",
        "sim/serve/pacing.py",
        "else _whole_us(start_ns)\n",
        "else _whole_us(start_ns + {ns})\n",
    ),
]


def tolerance_of(test):
    """Return the tolerance of a test that is marked ``clock`` [s]."""
    path, name = test.split("::")
    tree = ast.parse((ROOT / path).read_text())
    (function,) = (node for node in tree.body if getattr(node, "name", "") == name)
    (mark,) = (
        decorator
        for decorator in function.decorator_list
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "pytest.mark.clock"
    )
    return ast.literal_eval(mark.args[0])


def planted(text, delay, delay_s):
    """Return a module with a delay."""
    assert text.count(delay.old) == 1, (delay.path, delay.old, text.count(delay.old))
    return text.replace(delay.old, delay.new.format(s=delay_s, ns=round(delay_s * 1e9)))


def outcome_of(tree, test):
    """Run a test in a tree; return ``failed``, ``passed`` or ``not judged``."""
    report = tree.root / "delays.xml"
    code = tree.code_of("-m", "slow or not slow", "--junitxml", report, test, limit_s=600.0)
    assert code in {0, 1}, (test, code)
    if code == 1:
        return "failed"
    return "not judged" if "not judged: this computer" in report.read_text() else "passed"


def main():
    """Run the command line; return 1 where a delay was not found."""
    parser = argparse.ArgumentParser(prog="delays", description=__doc__)
    parser.add_argument("--count", type=int, default=10, help="runs with each delay")
    parser.add_argument("--only", default="", help="part of a test's name")
    options = parser.parse_args()
    missed = 0
    with tempfile.TemporaryDirectory(prefix="delays", ignore_cleanup_errors=True) as name:
        tree = Tree(Path(name))
        for delay in (delay for delay in DELAYS if options.only in delay.test):
            delay_s, path = 2 * tolerance_of(delay.test), tree.root / delay.path
            whole = path.read_text()
            path.write_text(planted(whole, delay, delay_s))
            outcomes = [outcome_of(tree, delay.test) for _ in range(options.count)]
            path.write_text(whole)
            counts = {kind: outcomes.count(kind) for kind in ("failed", "passed", "not judged")}
            missed += counts["failed"] < options.count
            listed = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
            function = delay.test.rpartition("::")[2]
            print(f"{function}: {delay_s:g} s in {delay.path}: {listed}", flush=True)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
