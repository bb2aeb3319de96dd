"""Command ``sim serve``."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from json import dumps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from undulog.capture.common.console import complain, echo
from undulog.capture.common.errors import UsageError

if TYPE_CHECKING:
    from undulog.capture.sources.contract import SourceEvent
    from undulog.capture.sources.unix_socket import FrameSender

    from ..scenario.bus_faults import BusFault
    from ..scenario.scenario import Scenario
    from ..serve.pacing import Pacer
    from ..serve.robot import Served
    from ..serve.socketcand_server import SocketcandServer, VirtualBus


_DEFAULT_HOST = "127.0.0.1"
_HIGHEST_PORT = 65535


def serve(
    scenario: str,
    /,
    *,
    socketcand: str | None = None,
    unix: Path | None = None,
    feetech: Path | None = None,
    bus: str = "can0",
    duration: float | None = None,
    wait: bool = False,
    lockstep: bool = False,
    fast: bool = False,
    fault: Annotated[tuple[str, ...], Parameter(name="--fault", show_default=False)] = (),
    seed: int | None = None,
    json: bool = False,
) -> int:
    """Be a robot on a bus: the twin, in real time, in a process of its own.

    Clients reach the bus as one of a socketcand server on this computer; a recorder that listens at
    a Unix socket gets its frames there, too. Frames are those of the robot's DBC, and so are the
    commands that the robot takes; the scenario's gait is not looked at. It runs until Ctrl-C or
    SIGTERM, both of which end it in good order.

    Example: `undulog sim serve flat --socketcand 29536 --wait`

    Then, in other terminals: `undulog record
    'can:socketcand:can0?port=29536' --robot snake25 -o run.mcap`, and a controller.

    As servos on a serial line: `undulog sim serve flat --feetech /tmp/ttySNAKE`, heard by
    `undulog record 'serial:/tmp/ttySNAKE.listen?protocol=feetech' --robot MINE.toml -o run.mcap`

    Args:
        scenario: Name of a shipped scenario (see `undulog sim list`), or a TOML file.
        socketcand: Serve clients at this `[HOST:]PORT` of the loopback; port 0 for any.
        unix: Send all frames to the recorder that listens at this path, once it is there.
        feetech: Be STS3215 servos 1, 2, ... on a pseudo-terminal at this path; everything on the
            line comes out at the path with `.listen`, too.
        bus: Name of the bus.
        duration: Simulated seconds to live, rather than until it is stopped.
        wait: Begin with the first command, so that no client misses anything.
        lockstep: Wait at each control tick until every servo has a command for it: the same
            commands then give the same run, whatever the machine does meanwhile. Begins with the
            first command, too.
        fast: With lockstep: don't keep to real time.
        fault: Something to go wrong, `KIND[:JOINT][:NUMBER][@FROM[+FOR]]`: `lost:joint07:0.1`,
            `stuck:joint07@5`, `frozen:joint07@5`, `over-current:joint07:1.5@5`, `bus-off@5+2`,
            `noise:0.001`, `delay:0.02`. May be repeated.
        seed: Seed of noise and faults, instead of the scenario's.
        json: Print one JSON object a line: first that it is ready and where, at the end how it
            went.
    """
    from ..scenario.bus_faults import parse_faults
    from ..scenario.scenario import LONGEST_S
    from ..scenario.scenario_file import load_scenario

    if socketcand is None and unix is None and feetech is None:
        raise UsageError(
            "this robot could not be reached: give --socketcand PORT or --unix PATH, "
            "or --feetech PATH"
        )
    if feetech is not None and (socketcand or unix or lockstep or fault):
        raise UsageError("--feetech is a line of its own: without --socketcand, --unix, --lockstep")
    if lockstep and socketcand is None:
        raise UsageError("in lockstep the robot waits for commands: give --socketcand PORT")
    if fast and not lockstep:
        raise UsageError("only in lockstep can the robot be faster than real time")
    chosen = load_scenario(scenario).changed(
        duration_s=LONGEST_S if duration is None else duration, seed=seed
    )
    if feetech is not None:
        return _run_feetech(chosen, feetech, wait=wait, json=json)
    if chosen.robot.bus is None:
        raise UsageError(f"{chosen.robot.name} has no bus map, so it has no frames for a bus")
    plan = _Plan(
        chosen,
        None if socketcand is None else parse_address(socketcand),
        unix,
        bus,
        parse_faults(fault, chosen.robot),
        lockstep=lockstep,
        wait=wait or lockstep,
        fast=fast,
        json=json,
    )
    return _run(plan)


def _run_feetech(scenario: Scenario, path: Path, *, wait: bool, json: bool) -> int:
    from undulog.capture.common.process import interruptible
    from undulog.capture.sources.events import EventLog

    from ..serve.feetech import FeetechRobot

    events = EventLog(time.monotonic_ns)
    with interruptible() as stop:
        robot = FeetechRobot(scenario, path, wait=wait, log_event=events.log_event)
        port, listen = map(str, robot.ports.paths)
        name, count = scenario.robot.name, len(scenario.robot.joints)
        ready = {"event": "ready", "robot": name, "port": port, "listen": listen, "waits": wait}
        line = f"{name} is {count} STS3215 servos at {port}; listen at {listen}"

        def announce() -> None:
            facts = ready | {"priority": robot.pacer.raise_priority()}
            echo(*([dumps(facts)] if json else [line]))

        try:
            duration_s = robot.run(announce, stop)
        finally:
            robot.pacer.lower_priority()
            robot.ports.close()
            _complain(events.flush())
    facts = {
        "event": "end",
        "duration_s": duration_s,
        **asdict(robot.pacer.tally),
        "commands": robot.chain.commands,
        "bytes_received": robot.ports.received,
        "bytes_sent": robot.ports.sent,
    }
    late = f"{1e3 * robot.pacer.tally.worst_s:.2g} ms late at worst"
    line = f"{name} ran for {duration_s:g} s, {late}; {robot.chain.commands} commands taken"
    echo(*([dumps(facts)] if json else [line]))
    return 0


@dataclass(frozen=True)
class _Plan:
    """What to serve, and where."""

    scenario: Scenario
    address: tuple[str, int] | None
    unix: Path | None
    bus: str
    faults: tuple[BusFault, ...]
    lockstep: bool
    wait: bool
    fast: bool
    json: bool


def _run(plan: _Plan) -> int:
    from undulog.capture.common.process import interruptible
    from undulog.capture.sources.events import EventLog
    from undulog.capture.sources.unix_socket import FrameSender

    from ..serve.pacing import Pacer
    from ..serve.robot import PERIOD_NS, VirtualRobot
    from ..serve.socketcand_server import SocketcandServer, VirtualBus

    events = EventLog(time.monotonic_ns)
    sender = None if plan.unix is None else FrameSender(plan.unix)
    server = None
    if plan.address is not None:
        server = SocketcandServer(*plan.address, plan.bus, events.log_event)
    bus = VirtualBus(server, sender, events.log_event)
    pacer = Pacer(PERIOD_NS, fast=plan.fast)
    with interruptible() as stop:
        try:
            robot = VirtualRobot(
                plan.scenario,
                bus,
                pacer,
                faults=plan.faults,
                lockstep=plan.lockstep,
                wait=plan.wait,
                log_event=events.log_event,
                each_tick=lambda: _complain(events.take()),
                stop=stop,
            )
            address = server.address if server else None
            served = robot.run(lambda: _print_ready(plan, address, pacer))
        finally:
            pacer.lower_priority()
            bus.close()
            _complain(events.flush())
    _print_end(plan, served, bus, server, sender)
    return 0


def _complain(events: Iterable[SourceEvent]) -> None:
    for event in events:
        complain(f"{event.level}: {event.text}")


def _print(plan: _Plan, facts: dict[str, Any], lines: list[str]) -> None:
    echo(*([dumps(facts)] if plan.json else lines))


def _print_ready(plan: _Plan, address: tuple[str, int] | None, pacer: Pacer) -> None:
    # The twin is built by now. In lockstep the controller waits for it, however long it takes.
    priority = None if plan.lockstep else pacer.raise_priority()
    host, port = address or (None, None)
    robot = plan.scenario.robot.name
    facts = {
        "event": "ready",
        "robot": robot,
        "scenario": plan.scenario.name,
        "bus": plan.bus,
        "host": host,
        "port": port,
        "unix": str(plan.unix) if plan.unix is not None else None,
        "waits": plan.wait,
        "epoch_ns": None if plan.fast else pacer.epoch_ns,
        "priority": priority,
    }
    places = [f"{host}:{port}"] if address else []
    places += [str(plan.unix)] if plan.unix is not None else []
    text = f"{robot} is on {plan.bus} at {' and '.join(places)}"
    _print(plan, facts, [text + ("; it waits for commands" if plan.wait else "")])


def _print_end(
    plan: _Plan,
    served: Served,
    bus: VirtualBus,
    server: SocketcandServer | None,
    sender: FrameSender | None,
) -> None:
    facts = {
        "event": "end",
        "duration_s": served.duration_s,
        "complete": served.complete,
        "start_s": served.start_ns * 1e-9,
        **asdict(served.pace),
        "frames": bus.sent,
        "heard": bus.received,
        "commands": served.commands,
        "lost": served.lost,
        "hit": served.hit,
        "dropped_clients": server.dropped if server else 0,
        "unix_accepted": sender.accepted if sender else None,
        "unix_refused": sender.refused if sender else None,
    }
    _print(plan, facts, _summary(plan, served, bus, sender))


def _summary(plan: _Plan, served: Served, bus: VirtualBus, sender: FrameSender | None) -> list[str]:
    pace = served.pace
    first = f"{plan.scenario.robot.name} ran for {served.duration_s:g} s of {plan.scenario.name}"
    if plan.fast:
        first += ", not in real time"
    elif plan.lockstep:
        first += f" in lockstep; its clock stood still for {pace.stood_still_s:.3g} s"
    elif pace.overruns:
        first += (
            f" and fell behind real time: {pace.overruns} of {pace.ticks} ticks came a period or "
            f"more late, {pace.worst_s:.3g} s at worst"
        )
        if pace.stood_still_s:
            first += f"; its time stood still for {pace.stood_still_s:.3g} s"
    else:
        first += f" in real time, {1e3 * pace.worst_s:.2g} ms late at worst"
    lines = [first, f"{bus.sent} frames sent, {served.commands} commands taken"]
    if sender is not None:
        lines.append(f"{sender.refused} frames found no recorder at {sender.path}")
    if plan.faults or plan.scenario.faults:
        lines.append(f"faults: {served.lost} replies lost, {served.hit} transmissions hit")
    return lines


def parse_address(text: str) -> tuple[str, int]:
    """Take ``[HOST:]PORT`` apart.

    Args:
        text: E.g. ``29536``, ``localhost:0`` or ``[::1]:29536``.

    Returns:
        Host, by default the loopback's address, and port.

    Raises:
        UsageError: If the port is none.
    """
    host, _, port = text.rpartition(":")
    if not (port.isascii() and port.isdigit() and int(port) <= _HIGHEST_PORT):
        raise UsageError(f"--socketcand {text}: expected [HOST:]PORT, e.g. 29536 or localhost:0")
    return host.strip("[]") or _DEFAULT_HOST, int(port)
