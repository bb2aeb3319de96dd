"""The tables of results, each described once: headings, values, digits, what is shown where.

Their model is :mod:`.analysis.parts.shown`; the terminal (:mod:`.text`) and the page
(:mod:`.page_tables`) lay them out. JSON, pandas
frames and Parquet hold every field of the same dataclasses in full and in SI units, so that their
names and types follow from the fields (:mod:`.data_frames`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from ..common import formats
from ..common.estimate import Estimate
from ..common.formats import degrees
from ..compare.decisions import SIGNIFICANT_DIFFERENCE, WORDS
from ..compare.words import decimals_of, in_people_units, people_unit, signed, signed_difference
from ..parts.joints.result import JointResult
from ..parts.shown import Column, ShownNumber, Table, p_cell, typical
from ..results.analysis import Analysis
from ..results.comparison import Comparison, Difference, NamedJoint, Waveform, of_body
from ..results.experiment import Experiment, MirrorJoint, Reversal, Run

_ENERGIES: tuple[tuple[str, str, Callable[[JointResult], float | None], int | None], ...] = (
    ("E_net", "integral of torque times velocity", lambda j: j.energy_net_j, 3),
    ("E_plus", "its positive part only", lambda j: j.energy_plus_j, None),
    ("E_abs", "its absolute value", lambda j: j.energy_abs_j, 6),
    ("E_el", "electrical, at the motor, signed", lambda j: j.energy_el_j, 4),
    ("E_el+", "its positive part only (no regeneration)", lambda j: j.energy_el_clipped_j, None),
)
"""Name, note and value of each energy, and when a narrow terminal goes without; None: page only."""

_NAMED = {
    True: (("gain", "gain, B over A"), ("lag", "lag, B minus A")),
    False: (("amplitude", "amplitude, B over A"), ("phase_lag", "phase lag, B minus A")),
}


def _significant(digits: int) -> Callable[[Sequence[Estimate]], int]:
    """Return the digits that show so many of the column's largest value."""
    return lambda column: formats.decimals_for_values(
        (estimate.value for estimate in column), digits
    )


def joint_table(analysis: Analysis, joints: Sequence[JointResult]) -> Table[JointResult]:
    """Return the response of joints, on a terminal with their energies.

    Args:
        joints: Those to show, in chain order.
    """

    def command(joint: JointResult) -> Estimate:
        return degrees(Estimate(joint.command_amplitude_rad))

    frequency = Column[JointResult]("Hz", "frequency [Hz]", lambda j: j.frequency_hz, (3, 4))
    columns: list[Column[JointResult]] = [
        Column("joint", "joint", lambda j: j.name, kind="word"),
        Column("plane", "plane", lambda j: j.plane, kind="word", spare=1),
        *([frequency] if len(analysis.gait.groups) > 1 else []),
        Column("command°", "command [°]", command, (1, 2), spare=5),
        Column("gain (95 %)", "gain [1]", lambda j: j.gain, typical(4, 4)),
        Column("lag° (95 %)", "lag [°]", lambda j: degrees(j.lag_rad), typical(2, 3)),
        *(
            Column[JointResult](f"{name} J", None, of, (_significant(3), 0), spare=spare)
            for name, _, of, spare in _ENERGIES
            if spare is not None and any(of(j) is not None for j in joints)
        ),
        Column("cover", None, lambda j: formats.coverage(j.coverage), spare=2),
        Column(None, "coverage [%]", lambda j: 100 * j.coverage, (0, 1)),
        Column(None, "samples", lambda j: j.samples),
        Column("flags", None, lambda j: " ".join(j.flags), kind="word"),
        Column(None, "flags", lambda j: ", ".join(j.flags), kind="word"),
    ]
    about = {
        "frequency [Hz]": "of the joint's group, for command, gain and lag",
        "command [°]": "amplitude of the command at the gait frequency",
        "gain [1]": "amplitude of the response over that of the command",
        "lag [°]": "response behind command, positive is late",
    }
    return Table(columns, joints, numbered=True, about=about)


def energy_table(joints: Sequence[JointResult]) -> Table[JointResult]:
    """Return the energies of every joint over the analysed windows, all with the same digits."""
    digits = _significant(4)([Estimate(of(joint)) for _, _, of, _ in _ENERGIES for joint in joints])
    columns: list[Column[JointResult]] = [
        Column(None, "joint", lambda j: j.name, kind="word"),
        *(Column(None, f"{name} [J]", of, (0, digits)) for name, _, of, _ in _ENERGIES),
    ]
    about = {f"{name} [J]": note for name, note, *_ in _ENERGIES}
    return Table(columns, joints, numbered=True, about=about)


def mirror_table(reversal: Reversal) -> Table[MirrorJoint]:
    """Each joint against its mirror joint."""
    relative, most = formats.relative, typical(3, 5)
    columns: list[Column[MirrorJoint]] = [
        Column("joint", "joint", lambda joint: joint.name, kind="word"),
        Column("its mirror", "its mirror", lambda joint: joint.mirror, kind="word", spare=1),
        Column(
            "gain % (95 %)", "gain [%]", lambda joint: relative(joint.log_gain_difference), most
        ),
        Column("lag° (95 %)", "lag [°]", lambda joint: degrees(joint.lag_difference_rad), most),
        Column("p", "p", lambda joint: p_cell(joint.p)),
    ]
    return Table(columns, reversal.joints)


def run_table(experiment: Experiment) -> Table[tuple[Run, Analysis]]:
    """Return the sessions of an experiment."""

    def start(session: Analysis) -> str:
        return formats.utc(session.session.start_ns).replace(" UTC", "")

    columns: list[Column[tuple[Run, Analysis]]] = [
        Column("session", "session", lambda row: formats.filename(row[0].path), kind="word"),
        Column(None, "robot", lambda row: row[1].session.robot, kind="word"),
        Column(None, "start [UTC]", lambda row: start(row[1]), kind="word"),
        Column(None, "length [s]", lambda row: row[1].session.duration_s, (1, 1)),
        Column("wave", "wave", lambda row: row[0].wave, kind="word", spare=1),
        Column("Hz", "frequency [Hz]", lambda row: row[1].gait.frequency_hz.value, (3, 4), spare=2),
        Column("role", "role", lambda row: row[0].role or "left out", kind="word"),
        Column(None, "recorder", lambda row: row[1].session.verdict, kind="word"),
        Column(None, "warnings", lambda row: len(row[1].warnings)),
    ]
    return Table(columns, list(zip(experiment.runs, experiment.sessions, strict=True)))


def difference_table(comparison: Comparison) -> Table[Difference]:
    """Every quantity of both sides."""

    def where(place: str) -> str:
        return f"the {place}" if of_body(place) else place

    columns: list[Column[Difference]] = [
        Column("joint", "where", lambda difference: where(difference.place), kind="word"),
        Column("quantity", "quantity", lambda difference: WORDS[difference.quantity], kind="word"),
        Column("A", "A", lambda difference: _side(difference, difference.a), spare=2),
        Column("B", "B", lambda difference: _side(difference, difference.b), spare=2),
        Column("B - A (95 %, all together)", None, signed_difference),
        Column(None, "B minus A", _difference),
        Column("p (Holm)", "p (Holm)", lambda difference: p_cell(difference.p_holm)),
        Column("in margins", None, lambda difference: f"{difference.size:.2g}", spare=1),
        Column(None, "size [margins]", lambda difference: difference.size, (0, 2)),
    ]
    rows = comparison.differences
    return Table(columns, rows, bold=lambda difference: difference.p_holm < SIGNIFICANT_DIFFERENCE)


def _side(difference: Difference, value: float) -> str:
    """Return the value of a side, with the digits and the unit of both."""
    factor, unit = people_unit(difference.unit)
    digits = formats.decimals_for_values([difference.a * factor, difference.b * factor], 4)
    return formats.number(value * factor, digits) + unit


def _difference(difference: Difference) -> ShownNumber:
    quantity, unit = in_people_units(difference)
    return ShownNumber(
        quantity, formats.decimals_for([quantity], most=decimals_of(difference)), unit
    )


def named_table(comparison: Comparison) -> Table[NamedJoint]:
    """Return the joints that differ, the largest difference first."""
    differences = {
        (difference.place, difference.quantity): _difference(difference)
        for difference in comparison.differences
    }
    columns: list[Column[NamedJoint]] = [
        Column(None, "joint", lambda joint: joint.name, kind="word"),
        *(
            Column(None, title, lambda joint, key=quantity: differences.get((joint.name, key)))
            for quantity, title in _NAMED[comparison.commanded]
        ),
        Column(None, "size [margins]", lambda joint: joint.size, (0, 1)),
        Column(None, "p (Holm)", lambda joint: p_cell(joint.p_holm)),
    ]
    return Table(columns, comparison.named, numbered=True)


def waveform_table(comparison: Comparison) -> Table[Waveform]:
    """How far the mean cycles of each joint are apart."""
    phase = "gait phase" if comparison.commanded else "phase"
    most, rms = "largest ° (95 %, by itself)", "RMS of B - A °"

    def at(waveform: Waveform) -> float:
        return math.degrees(waveform.largest_at_rad)

    columns: list[Column[Waveform]] = [
        Column("mean cycle of", "joint", lambda waveform: waveform.name, kind="word"),
        Column(rms, "RMS [°]", lambda waveform: math.degrees(waveform.rms_rad), (2, 3)),
        Column(most, None, lambda waveform: signed(degrees(waveform.largest), "")),
        Column(None, "largest [°]", lambda waveform: degrees(waveform.largest), (2, 2)),
        Column(f"at {phase} °", f"at {phase} [°]", at, spare=1),
    ]
    return Table(columns, comparison.waveforms)
