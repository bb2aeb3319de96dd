"""The virtual robot as a chain of Feetech STS3215 servos on pseudo-terminals.

The driver's port is the one that a program drives the servos through, as through a USB adapter. The
listener's port gets every byte of both ways and takes none: a second adapter, of which only the
receive line is connected. Registers are those of :mod:`.capture.robot.serial_servos`; servo k is
the robot's joint k, head to tail, from 1.
"""

from __future__ import annotations

import os
import select
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import UsageError
from undulog.capture.common.process import StopRequest
from undulog.capture.robot.model import Quantity, Robot
from undulog.capture.robot.serial_servos import (
    ACTION,
    BROADCAST,
    PING,
    READ,
    REG_WRITE,
    SERVOS,
    SYNC_READ,
    SYNC_WRITE,
    WRITE,
    PacketSplitter,
    feetech_packet,
)

from ..gait.contract import CONTROL_RATE_HZ, GaitTick, Readings
from ..physics.sensing import JointSample, SensorSample
from ..scenario.scenario import Scenario
from ..twin.recording import quick_collections
from ..twin.twin import Twin
from .pacing import Pacer

_REGISTERS = {register.quantity: register for register in SERVOS["feetech"]["sts3215"]}
_MEMORY = 128
_ID, _MODEL, _TORQUE = 5, 3, 40  # addresses
_STS3215 = 777
_AMBIENT = 25.0  # degC: the twin has no temperatures
_AWAY_S = 0.005


class ServoChain:
    """Servos that answer packets; their registers hold what the twin's servos report."""

    def __init__(self, robot: Robot) -> None:
        """Start with straight joints, or as near to that as the limits allow."""
        self._lower, self._upper = robot.limits()
        self.command: FloatArray = np.clip(np.zeros(len(robot.joints)), self._lower, self._upper)
        self.commands = 0
        self._memory = [bytearray(_MEMORY) for _ in robot.joints]
        self._staged: dict[int, tuple[int, bytes]] = {}
        for k, memory in enumerate(self._memory):
            memory[_MODEL : _MODEL + 2] = _STS3215.to_bytes(2, "little")
            memory[_ID], memory[_TORQUE] = k + 1, 1
            self._set(memory, Quantity.COMMAND, float(self.command[k]))
            self._set(memory, Quantity.POSITION, float(self.command[k]))
            self._set(memory, Quantity.TEMPERATURE, _AMBIENT)

    def report(self, samples: list[SensorSample]) -> None:
        """Set the registers to the newest samples of the twin's servos."""
        for sample in samples:
            if not isinstance(sample, JointSample):
                continue
            for k, memory in enumerate(self._memory):
                self._set(memory, Quantity.POSITION, float(sample.position[k]))
                self._set(memory, Quantity.VELOCITY, float(sample.velocity[k]))
                self._set(memory, Quantity.CURRENT, 1e3 * float(sample.current[k]))
                self._set(memory, Quantity.VOLTAGE, abs(float(sample.voltage[k])))

    @staticmethod
    def _set(memory: bytearray, quantity: Quantity, value: float) -> None:
        register = _REGISTERS[quantity]
        if np.isfinite(value):
            stop = register.address + register.size
            memory[register.address : stop] = register.bytes_of(value)

    def answer(self, packet: bytes) -> bytes:
        """Take a packet with a valid checksum; return what the servos send back."""
        servo, instruction, parameters = packet[2], packet[4], packet[5:-1]
        servos = range(1, len(self._memory) + 1)
        if instruction == SYNC_WRITE and len(parameters) > 2:
            size = parameters[1] + 1
            for at in range(2, len(parameters) - size + 1, size):
                self._write(parameters[at], parameters[0], parameters[at + 1 : at + size])
            return b""
        if instruction == SYNC_READ and len(parameters) > 2:
            return b"".join(
                self._read(parameter, *parameters[:2])
                for parameter in parameters[2:]
                if parameter in servos
            )
        if instruction == ACTION:
            for identifier in servos if servo == BROADCAST else (servo,):
                if identifier in self._staged:
                    self._write(identifier, *self._staged.pop(identifier))
        elif instruction == READ and servo in servos and len(parameters) == 2:
            return self._read(servo, *parameters)
        elif instruction in (WRITE, REG_WRITE) and len(parameters) > 1:
            for identifier in servos if servo == BROADCAST else (servo,):
                if instruction == REG_WRITE:
                    self._staged[identifier] = (parameters[0], parameters[1:])
                else:
                    self._write(identifier, parameters[0], parameters[1:])
        elif instruction != PING:
            return b""
        return feetech_packet(servo, 0) if servo in servos else b""

    def _read(self, servo: int, address: int, size: int) -> bytes:
        memory = self._memory[servo - 1]
        return feetech_packet(servo, 0, bytes(memory[address : address + size]).ljust(size, b"\0"))

    def _write(self, servo: int, address: int, data: bytes) -> None:
        if not 1 <= servo <= len(self._memory) or address + len(data) > _MEMORY:
            return
        memory, goal = self._memory[servo - 1], _REGISTERS[Quantity.COMMAND]
        memory[address : address + len(data)] = data
        if address <= goal.address and address + len(data) >= goal.address + goal.size:
            raw = goal.raw(bytes(memory[goal.address : goal.address + goal.size]))
            angle, k = raw * goal.scale + goal.offset, servo - 1
            self.command[k] = min(max(angle, self._lower[k]), self._upper[k])
            self.commands += 1


class ServoPorts:
    """The two pseudo-terminals, with links to them.

    Attributes:
        received: Bytes from the driver.
        sent: Bytes to the driver.
    """

    def __init__(self, path: Path, chain: ServoChain) -> None:
        """Open the driver's port at ``path`` and the listener's at ``path`` with ``.listen``.

        Raises:
            UsageError: If something else than a link is there.
        """
        self.paths = (path, path.with_name(path.name + ".listen"))
        self._chain = chain
        self._splitter = PacketSplitter("feetech")
        self._masters: list[int] = []
        self.received = self.sent = 0
        for link in self.paths:
            if os.path.lexists(link) and not link.is_symlink():
                raise UsageError(f"{link} is there and no link; give another --feetech PATH")
        for link in self.paths:
            master, slave = os.openpty()
            tty.setraw(slave)
            os.set_blocking(master, False)
            link.unlink(missing_ok=True)
            link.symlink_to(os.ttyname(slave))
            os.close(slave)
            self._masters.append(master)

    def pump(self, timeout_s: float) -> None:
        """Answer what the driver sends, for so long at most [s]."""
        driver = self._masters[0]
        if not select.select([driver], [], [], max(timeout_s, 0.0))[0]:
            return
        try:
            chunk = os.read(driver, 4096)
        except BlockingIOError:
            return
        except OSError:  # no driver has the port open
            time.sleep(min(max(timeout_s, 0.0), _AWAY_S))
            return
        self.received += len(chunk)
        for piece in self._splitter.feed(chunk):
            self._give(self._masters[1], piece.data)
            answer = self._chain.answer(piece.data) if piece.valid else b""
            if answer:
                self._give(driver, answer)
                self._give(self._masters[1], answer)
                self.sent += len(answer)

    @staticmethod
    def _give(master: int, data: bytes) -> None:
        with suppress(OSError):  # nobody reads: on a line nobody waits for a listener
            os.write(master, data)

    def close(self) -> None:
        """Close both, and remove the links; safe to call twice."""
        for master in self._masters:
            os.close(master)
        if self._masters:
            for path in self.paths:
                path.unlink(missing_ok=True)
        self._masters = []


class FeetechRobot:
    """The twin behind the ports; as a :class:`.Gait` it hands the driver's angles to it.

    Attributes:
        pacer: Its clock, and how well it kept up with real time.
    """

    names: tuple[str, ...] = ()

    def __init__(
        self, scenario: Scenario, path: Path, *, wait: bool, log_event: Callable[[str, str], None]
    ) -> None:
        """Open the ports; :meth:`run` brings it to life.

        Args:
            wait: Begin with the first command.
            log_event: Called with level and text of an event.

        Raises:
            UsageError: If the robot has too many joints, or the path is taken.
        """
        if len(scenario.robot.joints) >= BROADCAST:
            raise UsageError(f"a line has at most {BROADCAST - 1} servos")
        self._scenario, self._wait, self._say = scenario, wait, log_event
        self.chain = ServoChain(scenario.robot)
        self.ports = ServoPorts(path, self.chain)
        self.pacer = Pacer(10**9 // CONTROL_RATE_HZ)
        self._tick = 0
        self._twin: Twin | None = None
        self._stop = StopRequest()

    def run(self, ready: Callable[[], None], stop: StopRequest) -> float:
        """Run until the scenario ends or a stop is requested; return the simulated time [s].

        Raises:
            SimulationError: If the twin's state becomes impossible.
        """
        last = 0
        self._stop = stop
        with Twin(self._scenario, self) as self._twin, quick_collections():
            ready()
            for sample in self._twin.samples():
                last = sample.tick
                if stop.requested:
                    break
        return last / CONTROL_RATE_HZ

    def step(self, time_s: float, readings: Readings) -> GaitTick:
        """Serve the line until the tick is due; then report, and take the newest angles."""
        del time_s, readings
        tick, pacer = self._tick, self.pacer
        if not tick:
            while self._wait and not self.chain.commands and not self._stop.requested:
                self.ports.pump(0.05)
            pacer.start(pacer.now_ns())
        while (wait_s := pacer.wait_s(tick)) > 0.0:
            self.ports.pump(wait_s)
        if self._twin is not None:
            self.chain.report(self._twin.sensed)
        self.ports.pump(0.0)
        if pacer.begin(tick):
            self._say("warn", "the twin can't keep up: simulated time stood still")
        self._tick += 1
        return GaitTick(self.chain.command.copy(), np.empty(0), "bus", ())
