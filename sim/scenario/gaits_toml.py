"""The ``[gait]`` table of a scenario, read and written; ``docs/gaits.md`` lists its keys."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeVar, cast

from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Plane, Robot

from ..gait.build import GaitParameters
from ..gait.delay_blocks import DelayBlocks, DelayLine
from ..gait.oscillators import Numbers, OscillatorChain, OscillatorChains, OscillatorKind
from ..gait.serpentine import Serpentine
from ..gait.wave import PlaneGait, Wave

_Part = TypeVar("_Part")

LONGEST_DELAY_S = 10.0
"""Longest delay from one joint to the next."""

STRONGEST = 100.0
"""Greatest coupling, feedback and rate of an oscillator [1/s]: the control rate."""


class GaitKind(StrEnum):
    """The generators there are."""

    SERPENTINE = "serpentine"
    DELAY_BLOCKS = "delay-blocks"
    OSCILLATORS = "oscillators"


def read_gait(table: Table, robot: Robot | None, *, max_frequency_hz: float) -> GaitParameters:
    """Read the gait; faults are noted in the table.

    Args:
        table: The table ``[gait]``.
        robot: Who is to do it; None where that is a fault already.
        max_frequency_hz: What the control rate can carry.

    Returns:
        The parameters; of use only if no fault was noted.
    """
    kind = table.choice("kind", GaitKind) if "kind" in table else GaitKind.SERPENTINE
    if kind is GaitKind.OSCILLATORS:
        chains = _planes(table, robot, _oscillator_chain, max_frequency_hz)
        table.close()
        return OscillatorChains(chains)
    ramp_s = table.number("ramp_s", default=Serpentine.ramp_s, at_least=0.0)
    if kind is GaitKind.DELAY_BLOCKS:
        lines = _planes(table, robot, _delay_line, max_frequency_hz)
        table.close()
        return DelayBlocks(lines, ramp_s)
    if kind is None:  # a fault already, and no way to tell which keys belong here
        return Serpentine({}, ramp_s)
    waves = _planes(table, robot, _plane_gait, max_frequency_hz)
    table.close()
    return Serpentine(waves, ramp_s)


def gait_table(parameters: GaitParameters) -> dict[str, Any]:
    """The table that gives these parameters when it is read.

    Args:
        parameters: Of any kind of gait.

    Returns:
        Keys and values, every one written out.
    """
    values: dict[str, Any] = {}
    if isinstance(parameters, OscillatorChains):
        values["kind"] = GaitKind.OSCILLATORS
    else:
        delayed = isinstance(parameters, DelayBlocks)
        values["kind"] = GaitKind.DELAY_BLOCKS if delayed else GaitKind.SERPENTINE
        values["ramp_s"] = parameters.ramp_s
    for plane, one in parameters.planes.items():
        part = values[str(plane)] = dataclasses.asdict(one)
        if part.get("oscillator") is OscillatorKind.PHASE:
            del part["attraction"]  # which only Hopf oscillators have
    return values


def _planes(
    table: Table,
    robot: Robot | None,
    read: Callable[[Table, float, int | None], _Part],
    max_frequency_hz: float,
) -> dict[Plane, _Part]:
    """The driven planes."""
    planes: dict[Plane, _Part] = {}
    for plane in Plane:
        if plane not in table:
            continue
        count = None if robot is None else len(robot.joint_indices(plane))
        part = table.table(plane)
        planes[plane] = read(part, max_frequency_hz, count)
        part.close()
        if robot is not None and not count:
            table.fault(plane, f"leave it out: {robot.name} has no {plane} joints")
    if not planes:
        table.fault(Plane.HORIZONTAL, "a table for at least one plane, horizontal or vertical")
    return planes


def _common(part: Table, max_frequency_hz: float) -> dict[str, Any]:
    """What every kind of plane has."""
    wave = part.choice("wave", Wave) if "wave" in part else None
    return {
        "amplitude": part.number("amplitude", at_least=0.0),
        "frequency_hz": part.number("frequency_hz", above=0.0, at_most=max_frequency_hz),
        "wave": wave or Wave.HEAD_TO_TAIL,
        "offset": part.number("offset", default=0.0),
        "phase": part.number("phase", default=0.0),
    }


def _plane_gait(part: Table, max_frequency_hz: float, _: int | None) -> PlaneGait:
    return PlaneGait(**_common(part, max_frequency_hz), lag=part.number("lag", at_least=0.0))


def _delay_line(part: Table, max_frequency_hz: float, _: int | None) -> DelayLine:
    delay_s = part.number("delay_s", at_least=0.0, at_most=LONGEST_DELAY_S)
    return DelayLine(**_common(part, max_frequency_hz), delay_s=delay_s)


def _oscillator_chain(part: Table, max_frequency_hz: float, count: int | None) -> OscillatorChain:
    default = OscillatorChain
    kind = part.choice("oscillator", OscillatorKind) if "oscillator" in part else default.oscillator
    pairs = None if count is None else count - 1
    attraction = default.attraction
    if "attraction" in part:
        attraction = part.number("attraction", above=0.0, at_most=STRONGEST)
        if kind is OscillatorKind.PHASE:
            part.fault("attraction", "leave it out: phase oscillators have no radius to attract")
    chain = OscillatorChain(
        **_common(part, max_frequency_hz),
        lag=part.number("lag", at_least=0.0),
        oscillator=kind or default.oscillator,
        forward=_numbers(part, "forward", pairs, default.forward, most=STRONGEST),
        backward=_numbers(part, "backward", pairs, default.backward, most=STRONGEST),
        detuning=_numbers(part, "detuning", count, default.detuning, most=STRONGEST),
        start_phase=_numbers(part, "start_phase", count, default.start_phase),
        approach_rate=part.number(
            "approach_rate", default=default.approach_rate, above=0.0, at_most=STRONGEST
        ),
        attraction=attraction,
        feedback=part.number("feedback", default=default.feedback, at_least=0.0, at_most=STRONGEST),
        feedback_bias=_numbers(part, "feedback_bias", count, default.feedback_bias),
        kick_every_s=part.number("kick_every_s", default=default.kick_every_s, at_least=0.0),
        kick_size=part.number("kick_size", default=default.kick_size, at_least=0.0),
    )
    if chain.feedback > 0.0 and chain.amplitude == 0.0:
        part.fault("amplitude", "> 0 with feedback, which is measured against it")
    return chain


def _numbers(
    part: Table, key: str, count: int | None, default: Numbers, *, most: float | None = None
) -> Numbers:
    """One number, or an array of ``count``."""
    value = part.look(key)[1]
    least = None if most is None else -most
    if value is None:
        return default
    if not isinstance(value, list):
        return part.number(key, at_least=least, at_most=most)
    entries = cast("list[object]", value)
    if count is not None and len(entries) != count:
        part.fault(key, f"a number, or an array of {count}", f"an array of {len(entries)}")
        return default
    names = [f"{part.key(key)}[{i}]" for i in range(len(entries))]
    listed = Table(dict(zip(names, entries, strict=True)), "", part.faults)
    return tuple(listed.number(name, at_least=least, at_most=most) for name in names)
