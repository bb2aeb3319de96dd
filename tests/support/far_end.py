"""The far end of a drive's bus, in processes of its own: a robot behind socketcand, and a router.

It has socketcand and the frames of two robots, and imports nothing of the project: the robot
notes when each command arrived at its end, and :func:`largest_burst` judges by these times alone.

    far_end.py robot unasked|polled|slow|lossy PERIOD_S LATENCY_S
    far_end.py router PORT

Both print the port at which they listen. The robot prints ``first`` when the first command comes,
and at the end of its standard input all commands as JSON. The router takes lines at its standard
input: ``hold both|up|down|none`` (up: to the robot), ``bursts SECONDS``, ``late SECONDS``.
"""

import heapq
import json
import math
import re
import select
import socket
import struct
import sys
import time

STEP = math.radians(0.01)  # of angles on both buses
JOINTS = 25
SERVO = 0x14B
FRAME = re.compile(rb"< send ([0-9A-Fa-f]+) (\d+) ([0-9A-Fa-f ]+)>")


class Robot:
    """Servos at their commanded angles; they report unasked, or answer requests.

    ``unasked``: 25 joints report every ``period_s``. ``polled``: one servo answers each request,
    ``latency_s`` later. ``slow``: it looks at its bus every ``period_s`` only, takes all commands
    and answers one request. ``lossy``: as polled, and each 29th answer is lost.
    """

    def __init__(self, kind, period_s, latency_s):
        self.kind, self.period_s, self.latency_s = kind, period_s, latency_s
        self.arrivals = []  # (time [s], joint, angle [rad])
        self.angles = [0] * JOINTS
        self.asked = 0
        self.due = []  # (time, text), a heap
        self.next_s = time.monotonic()
        self.told_s, self.pause_s = None, 0.0

    def take(self, identifier, data):
        now = time.monotonic()
        if self.kind == "unasked":
            joint, raw = identifier - 0x101, struct.unpack("<h", data[:2])[0]
        elif data[0] == 0x92:
            self.asked += 1
            if self.kind != "slow" and not (self.kind == "lossy" and self.asked % 29 == 0):
                heapq.heappush(self.due, (now + self.latency_s, 0x92))
            return
        else:
            joint, raw = 0, struct.unpack("<i", data[4:])[0]
            heapq.heappush(self.due, (now + self.latency_s, 0xA4))
        if not self.arrivals:
            print("first", flush=True)
        self.arrivals.append((now, joint, raw * STEP))
        self.angles[joint] = raw

    def log_event(self):
        """Return the data that are due, and the time until the next are [s]."""
        now, text = time.monotonic(), b""
        while self.due and self.due[0][0] <= now:
            moved = frame(SERVO, struct.pack("<BbhhH", 0xA4, 30, 9, 0, 0))
            text += self.angle() if heapq.heappop(self.due)[1] == 0x92 else moved
        if self.kind in ("unasked", "slow") and now >= self.next_s:
            self.next_s = max(self.next_s + self.period_s, now)
            if self.kind == "unasked":
                for joint, raw in enumerate(self.angles):
                    text += frame(0x201 + joint, struct.pack("<hhhBb", raw, 0, 0, 20, 30))
            elif self.asked:
                text, self.asked = text + self.angle(), 0
        if text:
            if self.told_s is not None:
                self.pause_s = max(self.pause_s, now - self.told_s)
            self.told_s = now
        latest = self.next_s if self.kind in ("unasked", "slow") else now + 0.05
        return text, max(0.0, min(latest, self.due[0][0] if self.due else latest) - now)

    def angle(self):
        return frame(SERVO, bytes([0x92]) + self.angles[0].to_bytes(7, "little", signed=True))


def frame(identifier, data):
    """Return a frame with the robot's time, whose clock is set every 0.7 s, a day to and fro."""
    jump_s = 86400 * (int(time.monotonic() / 0.7) % 2)
    return b"< frame %X %.6f %s >" % (identifier, time.time() + jump_s, data.hex().encode())


def serve_robot(robot):
    """Serve one client of socketcand; end with standard input."""
    listener = socket.create_server(("127.0.0.1", 0))
    print(listener.getsockname()[1], flush=True)
    client = listener.accept()[0]
    client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    client.sendall(b"< hi >")
    rest, raw, wait_s = b"", False, 0.05
    sources = [client, sys.stdin]
    while sys.stdin in sources:
        ready = select.select(sources, [], [], wait_s)[0]
        if sys.stdin in ready:
            break
        if client in ready:
            chunk = client.recv(65536)
            if not chunk:
                sources.remove(client)
                raw, wait_s = False, 0.05
                if not robot.arrivals:
                    break
            rest += chunk
            end = rest.rfind(b">") + 1
            whole, rest = rest[:end], rest[end:]
            for text in re.findall(rb"<[^>]*>", whole):
                if match := FRAME.match(text):
                    data = bytes(int(byte, 16) for byte in match[3].split())
                    robot.take(int(match[1], 16), data)
                elif b"open" in text or b"rawmode" in text:
                    client.sendall(b"< ok >")
                    raw = raw or b"rawmode" in text
                    robot.next_s = time.monotonic() + 0.3  # python-can expects the answer alone
                else:
                    client.sendall(b"< error unknown command >")
        if raw:
            text, wait_s = robot.log_event()
            try:
                client.sendall(text)
            except OSError:
                sources.remove(client)
                raw, wait_s = False, 0.05
    print(json.dumps({"arrivals": robot.arrivals, "pause_s": robot.pause_s}), flush=True)


class Way:
    """One direction of the router: received data, and when they are sent."""

    def __init__(self, source, target):
        self.source, self.target, self.queue = source, target, []
        self.late_s = self.bursts_s = 0.0
        self.held = False

    def take(self):
        """Read received data; return False at the end."""
        try:
            chunk = self.source.recv(65536)
        except ConnectionResetError:
            chunk = b""
        due = time.monotonic() + self.late_s
        if self.bursts_s:
            due = math.ceil(due / self.bursts_s) * self.bursts_s
        self.queue.append((due, chunk))
        return bool(chunk)

    def pass_on(self):
        """Write the data that are due; an end is passed on, too."""
        while self.queue and not self.held and self.queue[0][0] <= time.monotonic():
            chunk = self.queue.pop(0)[1]
            try:
                if chunk:
                    self.target.sendall(chunk)
                else:
                    self.target.shutdown(socket.SHUT_WR)
            except OSError:
                self.queue.clear()


def route(port):
    """Route between one client and the robot."""
    listener = socket.create_server(("127.0.0.1", 0))
    print(listener.getsockname()[1], flush=True)
    client = listener.accept()[0]
    robot = socket.create_connection(("127.0.0.1", port))
    for side in (client, robot):
        side.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    up, down = Way(client, robot), Way(robot, client)
    sources = [sys.stdin, client, robot]
    while True:
        ready = select.select(sources, [], [], 0.001)[0]
        if sys.stdin in ready:
            words = sys.stdin.readline().split()
            if not words:
                return
            for way, name in ((up, "up"), (down, "down")):
                if words[0] == "hold":
                    way.held = words[1] in ("both", name)
                else:
                    setattr(way, f"{words[0]}_s", float(words[1]))
        for way in (up, down):
            if way.source in ready and not way.take():
                sources.remove(way.source)
            way.pass_on()


def largest_burst(arrivals, within_s=0.005):
    """Return the largest change of one joint's command by arrivals within a short time [rad].

    A change counts from the command that was in force before the first of them.
    """
    worst = 0.0
    for joint in range(JOINTS):
        changes = [(t, angle) for t, number, angle in arrivals if number == joint]
        first = 0
        for k in range(1, len(changes)):
            while changes[k][0] - changes[first][0] > within_s:
                first += 1
            group = [angle for _, angle in changes[max(first - 1, 0) : k + 1]]
            worst = max(worst, max(group) - min(group))
    return worst


def beyond_rate(arrivals, max_rate, period_s):
    """By how much a change exceeds ``max_rate * (time + period)``, between any arrivals [rad]."""
    import numpy as np  # where it is judged only: the robot's process has no use for it

    worst = -math.inf
    for joint in {number for _, number, _ in arrivals}:
        changes = np.array([(t, angle) for t, number, angle in arrivals if number == joint])
        t, angle = changes.T
        for apart in range(1, min(200, len(changes) - 2) + 1):
            change = np.abs(angle[apart + 1 :] - angle[: -apart - 1])
            beyond = change - max_rate * (t[apart + 1 :] - t[1:-apart] + period_s)
            worst = max(worst, float(beyond.max()))
    return worst


if __name__ == "__main__":
    if sys.argv[1] == "robot":
        serve_robot(Robot(sys.argv[2], float(sys.argv[3]), float(sys.argv[4])))
    else:
        route(int(sys.argv[2]))
