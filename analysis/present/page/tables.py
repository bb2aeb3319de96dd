"""Key figures and the columns of the tables of joints."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from undulog.capture.common.console import plain

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.estimate import Estimate
from .driven import is_driven


@dataclass(frozen=True)
class Column:
    """One column of the tables of joints.

    Attributes:
        title: Heading with its unit.
        note: What it is, shown below the table.
        cells: One estimate a joint, in the unit of the heading.
        decimals: Digits after the point.
    """

    title: str
    note: str
    cells: tuple[Estimate, ...]
    decimals: int


@dataclass(frozen=True)
class Fact:
    """One key figure.

    Attributes:
        name: What it is.
        value: With unit.
        note: Where or when, in small print; may be empty.
    """

    name: str
    value: str
    note: str = ""


def response_columns(joints: Sequence[JointResult]) -> tuple[Column, ...]:
    """Command, gain and lag of every joint, angles in degrees.

    Args:
        joints: In chain order.

    Returns:
        Three columns; the frequency before them where joints have several.
    """
    command = tuple(formats.degrees(Estimate(j.command_amplitude_rad)) for j in joints)
    gain = tuple(j.gain for j in joints)
    lag = tuple(formats.degrees(j.lag_rad) for j in joints)
    return (
        *_frequency_column(joints),
        Column("command [°]", "amplitude of the command at the gait frequency", command, 2),
        Column(
            "gain [1]",
            "amplitude of the response over that of the command",
            gain,
            formats.decimals_for(gain, most=4),
        ),
        Column(
            "lag [°]",
            "response behind command, positive is late",
            lag,
            formats.decimals_for(lag, most=3),
        ),
    )


def _frequency_column(joints: Sequence[JointResult]) -> list[Column]:
    if len({joint.group for joint in joints} - {None}) < 2:
        return []
    cells = tuple(Estimate(joint.frequency_hz) for joint in joints)
    return [Column("frequency [Hz]", "of the joint's group, for command, gain and lag", cells, 4)]


def energy_columns(joints: Sequence[JointResult]) -> tuple[Column, ...]:
    """The energies of every joint over the analysed windows, all with the same decimals.

    Args:
        joints: In chain order.

    Returns:
        Five columns.
    """
    kinds: tuple[tuple[str, str, Callable[[JointResult], float | None]], ...] = (
        ("E_net", "integral of torque times velocity", lambda j: j.energy_net_j),
        ("E_plus", "its positive part only", lambda j: j.energy_plus_j),
        ("E_abs", "its absolute value", lambda j: j.energy_abs_j),
        ("E_el", "electrical, at the motor, signed", lambda j: j.energy_el_j),
        ("E_el+", "its positive part only (no regeneration)", lambda j: j.energy_el_clipped_j),
    )
    decimals = formats.decimals_for_values((of(j) for _, _, of in kinds for j in joints), 4)
    return tuple(
        Column(f"{name} [J]", note, tuple(Estimate(of(j)) for j in joints), decimals)
        for name, note, of in kinds
    )


def key_figures(analysis: Analysis) -> list[Fact]:
    """The figures that stand at the top of the page; what is unknown is an en dash.

    Args:
        analysis: The numbers.

    Returns:
        Eight facts, seven where there are no joints.
    """
    gait, joints = analysis.gait, analysis.joints
    driven = [joint for joint in joints if is_driven(joint)]
    frequency = formats.gait_frequency(gait)
    facts = [
        Fact("Gait frequency", frequency, _analysed(analysis)),
        Fact("Wave", (gait.wave or formats.MISSING).replace("-", " "), _lag_per_joint(analysis)),
        Fact(
            "Joints in the gait",
            f"{len(driven)} of {len(joints)}" if driven else formats.MISSING,
        ),
    ]
    gains = [(j.gain.value, j.name) for j in joints if j.gain.value is not None]
    lags = [(math.degrees(v), j.name) for j in joints if (v := j.lag_rad.value) is not None]
    facts.append(_range("Gain", gains, formats.decimals_for((j.gain for j in joints), most=3), ""))
    facts.append(_range("Lag", lags, 1, "°"))
    energies = [j.energy_abs_j for j in joints if j.energy_abs_j is not None]
    total = math.fsum(energies)
    digits = formats.decimals_for_values([total])
    facts.append(
        Fact(
            "Mechanical energy E_abs",
            f"{formats.number(total, digits)} J" if energies else formats.MISSING,
            f"{len(energies)} of {len(joints)} joints" if energies else "",
        )
    )
    if joints:
        least = min(joints, key=lambda j: j.coverage)
        where = plain(least.name) if least.coverage < 0.9995 else "every joint"
        facts.append(Fact("Lowest coverage", formats.coverage(least.coverage), where))
    points = analysis.body.observed if analysis.body is not None else ()
    sizes = [formats.number(formats.scaled(p.amplitude_m, 1000.0).value, 0) for p in points]
    facts.append(
        Fact(
            "Body amplitude",
            " / ".join(sizes) + " mm" if sizes else formats.MISSING,
            plain(" / ".join(p.place for p in points)),
        )
    )
    return facts


def _range(name: str, values: Sequence[tuple[float, str]], decimals: int, unit: str) -> Fact:
    if not values:
        return Fact(name, formats.MISSING)
    (low, first), (high, last) = min(values), max(values)
    if len(values) == 1:
        return Fact(name, formats.number(low, decimals) + unit, plain(first))
    text = f"{formats.number(low, decimals)}{unit} to {formats.number(high, decimals)}{unit}"
    return Fact(name, text, plain(f"{first}, {last}"))


def _analysed(analysis: Analysis) -> str:
    windows = analysis.gait.windows
    if not windows:
        return "nothing analysed"
    cycles = math.fsum(window.cycles for window in windows)
    spans = ", ".join(f"{w.start_s:.2f} to {w.stop_s:.2f} s" for w in windows[:3])
    more = f" and {len(windows) - 3} more" if len(windows) > 3 else ""
    return f"{cycles:.0f} cycles, {spans}{more}" if cycles else f"{spans}{more}"


def _lag_per_joint(analysis: Analysis) -> str:
    return ", ".join(
        f"{formats.number(math.degrees(lag), 1)}° a joint, {plain(plane)}"
        for plane, lag in analysis.gait.lag_per_joint_rad.items()
    )
