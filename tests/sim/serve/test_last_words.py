"""What was sent last reaches the robot, also where the connection is closed at once."""

import threading
import time

import numpy as np
import pytest

from support.processes import wait_for
from undulog.capture.log.messages.frames import empty_frames
from undulog.capture.sources.address import parse_address
from undulog.capture.sources.events import Tally
from undulog.sim.drive.links import find_virtual_robot
from undulog.sim.serve.socketcand_server import HOLD_S, SocketcandServer

COUNT = 40


def frames(count):
    found = empty_frames(count)
    found["id_flags"], found["dlc"] = 0x101, 2
    found["data"][:, 0] = np.arange(count)
    return found


class Pumped:
    """A server, its clients served by a thread between :meth:`go` and :meth:`rest`."""

    def __init__(self):
        self.server = SocketcandServer("127.0.0.1", 0, "can0", lambda _level, _text: None)
        self.server.identity = "virtual-robot snake25 paced"
        self.server.mark(0)
        self._ended = threading.Event()
        self._thread = None

    def go(self):
        self._ended.clear()
        self._thread = threading.Thread(target=self._pump)
        self._thread.start()

    def rest(self):
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _pump(self):
        while not self._ended.is_set():
            self.server.pump(0.01)


@pytest.fixture
def pumped():
    made = Pumped()
    yield made
    made.rest()
    made.server.close()


def test_commands_that_the_robot_has_not_read_survive_the_end_of_the_connection(pumped):
    address = parse_address(f"can:socketcand:can0?port={pumped.server.address[1]}")
    pumped.go()
    link = find_virtual_robot(address, Tally(lambda: 0))
    time.sleep(2 * HOLD_S)
    pumped.rest()
    # The robot told more than the controller has read, so that its end resets the connection; and
    # the robot speaks again before it listens.
    pumped.server.broadcast(frames(COUNT))
    link.send(frames(COUNT))
    link.close()
    for _ in range(3):
        pumped.server.broadcast(frames(COUNT))
    assert pumped.server.waiting == 0  # it has not listened yet
    pumped.go()
    wait_for(lambda: not (pumped.server.clients))
    pumped.rest()
    sent = list(iter(pumped.server.take, None))
    assert [one.record[24] for one in sent] == list(range(COUNT))
    link.close()  # again, and nothing happens
