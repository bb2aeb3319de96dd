"""Real signals to a real process: the file is whole, the second signal kills."""

import signal
import threading

import pytest

from support.processes import python_started
from undulog.capture import Session
from undulog.capture.common.process import interrupted_later

RECORDER = """
import sys, time
from undulog.capture import SessionWriter
from undulog.capture.common.process import interruptible

with interruptible() as stop, SessionWriter(sys.argv[1], session_id="s", epoch_ns=10**18) as writer:
    channel = writer.joint_state("/joint_states", ["a"], unit="rad")
    tick = 0
    while not stop.requested:
        channel.write(10**18 + tick * 10**6, [float(tick)])
        tick += 1
        if tick == 100:
            print("recording", flush=True)
        time.sleep(1e-4)
print(tick, flush=True)
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_ends_between_samples_and_leaves_a_whole_file(tmp_path, number):
    path = tmp_path / "s.mcap"
    process = python_started(RECORDER, path)
    assert process.stdout.readline() == "recording\n"
    process.send_signal(number)
    ticks = int(process.communicate()[0])
    assert process.returncode == 0
    with Session.open(path) as session:
        assert session.warnings == []
        assert session.joints("/joint_states").values[0].tolist() == list(range(ticks))


def test_an_interrupt_is_raised_after_the_block_that_it_must_not_end():
    done = []
    with pytest.raises(KeyboardInterrupt):  # noqa: PT012
        with interrupted_later():
            signal.raise_signal(signal.SIGINT)
            done.append("the block")
        done.append("what follows")
    assert done == ["the block"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with interrupted_later():
        pass
    thread = threading.Thread(target=interrupted_later().__enter__)
    thread.start()
    thread.join()


def test_the_second_signal_acts_as_usual():
    code = (
        "import time; from undulog.capture.common.process import interruptible\n"
        "with interruptible() as stop:\n"
        "    print('in', flush=True)\n"
        "    while not stop.requested: time.sleep(1e-3)\n"
        "    print('asked', flush=True)\n"
        "    time.sleep(60)\n"
    )
    process = python_started(code)
    assert process.stdout.readline() == "in\n"
    process.send_signal(signal.SIGTERM)
    assert process.stdout.readline() == "asked\n"
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == -signal.SIGTERM
