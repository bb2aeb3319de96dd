"""The ``[gait]`` table of a scenario, read and written; its keys: ``docs/reference/gaits.md``."""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from typing import Any, TypeAlias, cast

from undulog.capture.common.config import Declared, declared, read, read_fields, write
from undulog.capture.common.strict_table import Table
from undulog.capture.robot.model import Plane, Robot

from ..gait.contract import Generator
from ..gait.delay_blocks import DelayBlockGait, DelayBlocks, DelayLine
from ..gait.oscillators import (
    Numbers,
    OscillatorChain,
    OscillatorChains,
    OscillatorGait,
    OscillatorKind,
)
from ..gait.wave import PlaneGait, Serpentine, SerpentineGait

GaitParameters: TypeAlias = Serpentine | DelayBlocks | OscillatorChains
"""Gait parameters of a scenario."""


def generator(parameters: GaitParameters, robot: Robot, *, per_joint: bool = False) -> Generator:
    """The generator of a gait, at time zero with straight joints.

    Args:
        robot: The robot.
        per_joint: Log the values of every joint, for a controller that sets joints apart.
    """
    if isinstance(parameters, DelayBlocks):
        return DelayBlockGait(parameters, robot)
    if isinstance(parameters, OscillatorChains):
        return OscillatorGait(parameters, robot)
    return SerpentineGait(parameters, robot, per_joint=per_joint)


class GaitKind(StrEnum):
    """The generators there are."""

    SERPENTINE = "serpentine"
    DELAY_BLOCKS = "delay-blocks"
    OSCILLATORS = "oscillators"


PlaneParameters: TypeAlias = PlaneGait | DelayLine | OscillatorChain
_KINDS: dict[GaitKind, tuple[type[GaitParameters], type[PlaneParameters]]] = {
    GaitKind.SERPENTINE: (Serpentine, PlaneGait),
    GaitKind.DELAY_BLOCKS: (DelayBlocks, DelayLine),
    GaitKind.OSCILLATORS: (OscillatorChains, OscillatorChain),
}


def read_gait(table: Table, robot: Robot | None) -> GaitParameters:
    """Read the gait; faults are noted in the table.

    Args:
        table: The table ``[gait]``.
        robot: The robot; None where that is a fault already.

    Returns:
        The parameters; of use only if no fault was noted.
    """
    kind = table.choice("kind", GaitKind, GaitKind.SERPENTINE)
    if kind is None:  # no way to tell which keys belong here
        return read_fields(table, Serpentine, planes=dict)
    gait, part = _KINDS[kind]
    return read(table, gait, planes=lambda: _planes(table, robot, part))


def gait_table(parameters: GaitParameters) -> dict[str, Any]:
    """The table that gives these parameters when it is read.

    Args:
        parameters: Of any kind of gait.

    Returns:
        Keys and values, every one written out.
    """
    values = write(parameters)
    del values["planes"]
    kind = next(kind for kind, (gait, _) in _KINDS.items() if isinstance(parameters, gait))
    values = {"kind": kind, **values}
    for plane, one in parameters.planes.items():
        part = values[str(plane)] = write(one)
        if part.get("oscillator") is OscillatorKind.PHASE:
            del part["attraction"]  # which only Hopf oscillators have
    return values


def _planes(
    table: Table, robot: Robot | None, part: type[PlaneParameters]
) -> dict[Plane, PlaneParameters]:
    planes: dict[Plane, PlaneParameters] = {}
    for plane in Plane:
        if plane not in table:
            continue
        count = None if robot is None else len(robot.joint_indices(plane))
        own = table.table(plane)
        planes[plane] = (
            _oscillator_chain(own, count) if part is OscillatorChain else read(own, part)
        )
        if robot is not None and not count:
            table.fault(plane, f"leave it out: {robot.name} has no {plane} joints")
    if not planes:
        table.fault(Plane.HORIZONTAL, "a table for at least one plane, horizontal or vertical")
    return planes


def _oscillator_chain(part: Table, count: int | None) -> OscillatorChain:
    def numbers(name: str, number: int | None) -> Callable[[], Numbers]:
        return lambda: _numbers(part, declared(OscillatorChain)[name], number)

    pairs = None if count is None else count - 1
    chain = read_fields(
        part,
        OscillatorChain,
        forward=numbers("forward", pairs),
        backward=numbers("backward", pairs),
        detuning=numbers("detuning", count),
        start_phase=numbers("start_phase", count),
        feedback_bias=numbers("feedback_bias", count),
    )
    if chain.oscillator is OscillatorKind.PHASE and "attraction" in part:
        part.fault("attraction", "leave it out: phase oscillators have no radius to attract")
    part.close()
    return chain


def _numbers(part: Table, one: Declared, count: int | None) -> Numbers:
    """One number, or an array of ``count``."""
    value = part.look(one.key)[1]
    if not isinstance(value, list):
        return part.number(one.key, *one.bounds, default=one.default)
    entries = cast("list[object]", value)
    if count is not None and len(entries) != count:
        part.fault(one.key, f"a number, or an array of {count}", f"an array of {len(entries)}")
        return one.default
    each = {f"{part.key(one.key)}[{i}]": entry for i, entry in enumerate(entries)}
    listed = Table(each, "", part.faults)
    return tuple(listed.number(name, *one.bounds) for name in each)
