"""Gain and lag over time: by the phase on ``/gait``, and cycle by cycle of a steady gait.

Of a steady gait each cycle's samples are fitted alone, by least squares on their own times::

    q(t) = b + Re a exp(j omega t),    omega of the whole stretch

so a is noisier than the fit over all cycles, and is a description of how the response went on, not
a better estimate. What stands against it is the command's amplitude over the whole stretch.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray
from undulog.capture.common.console import Warn
from undulog.capture.common.errors import DataError, LogError
from undulog.capture.common.process import in_threads

from ...common.remarks import Note
from ...estimators.demodulation import (
    CycleResponses,
    LoggedPhase,
    cycles_of,
    demodulate,
)
from ...estimators.intervals import t_factor
from ...estimators.series import GAP_FACTOR, Series, clean
from ...signals.columns import Columns, planes_of
from ...signals.stretch import GAIT_TOPIC
from ..artefacts.result import Artefact, Span
from .result import Intervals, JointOverTime, Maybe, ResponseOverTime

_Value = TypeVar("_Value")

STEP_SHARE = 0.05
"""A change of A or omega from one logged value to the next by more than this share of its largest
is sudden: controllers change them smoothly."""

STEP_RAD = 0.05
"""The same for offset, lag and phase [rad]."""


@dataclass(frozen=True)
class _Pace:
    """A phase over one run, and the edges of its cycles [s]."""

    phase: LoggedPhase
    edges_s: FloatArray


@dataclass(frozen=True)
class LoggedGait:
    """What the controller meant, as it was logged on ``/gait``.

    Attributes:
        t_s: Times [s], shape (n,).
        values: Values by name, shapes (n,); phases run on over a whole turn.
    """

    t_s: FloatArray
    values: Mapping[str, FloatArray]

    @property
    def phases(self) -> list[str]:
        """Names of the phases."""
        return [name for name in self.values if name.endswith(".phase")]

    def phase_name(self, joint: str, plane: str) -> str | None:
        """Which phase a joint follows.

        Args:
            joint: The joint's name.
            plane: Its plane; empty where no robot says.

        Returns:
            The name of its own phase, else of its plane's, else of the only one; None without.
        """
        for name in (f"{joint}.phase", f"{plane}.phase"):
            if name in self.phases:
                return name
        return self.phases[0] if len(self.phases) == 1 else None

    def paces(self, name: str, runs: Sequence[tuple[int, int]]) -> list[_Pace | None]:
        """A phase and its cycles in each run; None where it stands or turns back."""
        rising = (_rising(self.t_s[i:j], self.values[name][i:j]) for i, j in runs)
        return [None if phase is None else _Pace(phase, phase.edges_s()) for phase in rising]

    def runs(self) -> list[tuple[int, int]]:
        """Where the gait goes on without a sudden change or a gap.

        Returns:
            Half-open ranges of indices, of more than two samples each.
        """
        step = np.diff(self.t_s)
        broken: BoolArray = step > GAP_FACTOR * np.median(step)
        for name, value in self.values.items():
            kind = name.rpartition(".")[2]
            change = np.abs(np.diff(value))
            if kind in ("A", "omega"):
                broken |= change > STEP_SHARE * np.abs(value).max()
            elif kind in ("offset", "lag"):
                broken |= change > STEP_RAD
            elif kind == "phase":
                # Of a phase that runs evenly but for a controller, no second difference is large.
                broken[1:] |= np.abs(np.diff(value, n=2)) > STEP_RAD
        edges = [0, *(np.flatnonzero(broken) + 1).tolist(), self.t_s.size]
        return [(i, j) for i, j in pairwise(edges) if j - i > 2]


def response_over_time(
    session: SessionView, columns: Columns, artefacts: Iterable[Artefact], warn: Warn
) -> ResponseOverTime | None:
    """Return the gain and lag of every driven joint in every cycle of its logged phase.

    Args:
        artefacts: What falsifies positions, and when.
        warn: Told why there is no result.

    Returns:
        The response over time, or None.
    """
    if not columns.command or not columns.position:
        return None  # with a warning where they were read
    logged = _logged(session, warn)
    if logged is None:
        return None
    false: dict[str, list[Span]] = {}
    for artefact in artefacts:
        if artefact.falsifies("position"):
            false.setdefault(artefact.joint, []).extend(artefact.spans_s)
    planes = planes_of(session.robot)
    runs = logged.runs()
    paces = {name: logged.paces(name, runs) for name in logged.phases}
    settled_s = session.settle_s or 0.0
    origin_ns = session.start_ns

    def of_joint(name: str) -> JointOverTime | None:
        plane = planes.get(name, "")
        phase = logged.phase_name(name, plane)
        if phase is None or name not in columns.command or name not in columns.position:
            return None
        command, response = (
            clean(name, signal.t_ns, signal.values, origin_ns)
            for signal in (columns.command[name], columns.position[name])
        )
        if command.count < 2 or np.ptp(command.values) == 0 or response.count < 2:
            return None
        main = logged.phase_name("", plane) or phase
        pairs = zip(paces[main], paces[phase], strict=True)
        return _joint(command, response, [*pairs], false=false.get(name, []), settled_s=settled_s)

    samples = sum(
        signal.t_ns.size for signal in (*columns.command.values(), *columns.position.values())
    )
    results = in_threads(of_joint, columns.names, samples, session.forget)
    joints = [result for result in results if result is not None]
    if not any(any(g is not None for g in joint.gain) for joint in joints):
        why = "no whole cycle of the logged phase drives a joint"
        warn(Note(f"gain and lag over time are null: {why}"))
        return None
    ends = logged.t_s
    return ResponseOverTime(
        tuple((float(ends[i]), float(ends[j - 1])) for i, j in runs), tuple(joints)
    )


def _logged(session: SessionView, warn: Warn) -> LoggedGait | None:
    why = f"the session has no {GAIT_TOPIC}"
    if GAIT_TOPIC in session.channels:
        try:
            logged = session.joints(GAIT_TOPIC)
        except (DataError, LogError) as error:
            why = str(error)
        else:
            values = dict(zip(logged.names, logged.values, strict=True))
            even = len({t.size for t in logged.t_ns}) == 1 and logged.t_ns[0].size > 2
            if even and any(name.endswith(".phase") for name in values):
                t_s = (logged.t_ns[0] - session.start_ns).astype(np.float64) * 1e-9
                finite = np.isfinite(np.stack(list(values.values()))).all(axis=0)
                by_name = {name: value[finite] for name, value in values.items()}
                # A log may keep its phases within a turn, or not.
                by_name |= {k: np.unwrap(v) for k, v in by_name.items() if k.endswith(".phase")}
                return LoggedGait(t_s[finite], by_name)
            why = f"{GAIT_TOPIC} logs no phase"
    warn(Note(f"gain and lag over time are null: {why}"))
    return None


def _joint(
    command: Series,
    response: Series,
    paces: Sequence[tuple[_Pace | None, _Pace | None]],
    *,
    false: Sequence[Span],
    settled_s: float,
) -> JointOverTime:
    """One joint; cycles are those of its plane's phase, turned back by its own."""
    edges: list[FloatArray] = []
    asked: list[ComplexArray] = []
    given: list[ComplexArray] = []
    number: list[int] = []
    for k, (main, pace) in enumerate(paces):
        if main is None or pace is None or main.edges_s.size < 2:
            continue
        pair = demodulate(command, response, pace.phase, main.edges_s)
        edges.append(main.edges_s)
        asked.append(pair[0])
        given.append(pair[1])
        number += [k] * (main.edges_s.size - 1)
    if not edges:
        return JointOverTime(command.name, *[()] * 8)
    cycles = cycles_of(edges, asked, given, settled_s=settled_s)
    for start, stop in false:
        cycles.ratio[(cycles.start_s < stop) & (cycles.stop_s > start)] = np.nan
    frequency = 1 / (cycles.stop_s - cycles.start_s)
    start, stop = tuple(cycles.start_s.tolist()), tuple(cycles.stop_s.tolist())
    rates = tuple(frequency.tolist())
    return JointOverTime(command.name, start, stop, tuple(number), rates, *_estimates(cycles))


def _rising(t_s: FloatArray, value: FloatArray) -> LoggedPhase | None:
    """A phase that always increases, or None where it stands or turns back."""
    whole = value if value[-1] >= value[0] else -value
    return LoggedPhase(t_s, whole) if np.all(np.diff(whole) > 0) else None


def _estimates(cycles: CycleResponses) -> tuple[Maybe, Intervals, Maybe, Intervals]:
    """Gain and lag with their intervals, as :mod:`.analysis.response.response` has them."""
    factor = t_factor(cycles.dof) if cycles.dof > 0 else float("nan")
    gain, lag = np.abs(cycles.ratio), -np.angle(cycles.ratio)
    half = factor * np.sqrt(cycles.variance)
    valid = np.isfinite(cycles.ratio) & (gain > 0)
    sure = valid & (half < 1)
    half = np.where(sure, half, 0.0)
    low, high = gain * np.exp(-half), gain * np.exp(half)
    early, late = lag - np.arcsin(half), lag + np.arcsin(half)
    return (
        _where(valid, gain.tolist()),
        _where(sure, zip(low.tolist(), high.tolist(), strict=True)),
        _where(valid, lag.tolist()),
        _where(sure, zip(early.tolist(), late.tolist(), strict=True)),
    )


def _where(valid: BoolArray, values: Iterable[_Value]) -> tuple[_Value | None, ...]:
    """Return the values, or None where they are not known."""
    pairs = zip(values, valid.tolist(), strict=True)
    return tuple(value if there else None for value, there in pairs)
