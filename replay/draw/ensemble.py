"""The mean cycle of a gait: what every joint does from 0 to 360 degrees of its phase.

Samples are never folded. Each keeps its own time, and with it the phase that the controller logged
(or that of the fitted rhythm, where none was logged). Over that phase a channel is fitted by
harmonics and cut into whole cycles, which are averaged phase by phase
(:func:`.analysis.compare.side.cycles_by_phase`); their scatter is the interval of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.analysis.compare.quantities import from_runs
from undulog.analysis.compare.side import PHASES, cycles_by_phase, phases_rad
from undulog.analysis.estimators.harmonic import fit_at
from undulog.analysis.estimators.intervals import t_factor
from undulog.analysis.estimators.series import Series, clean
from undulog.analysis.response.rhythm import allowed_model
from undulog.analysis.results.analysis import Analysis
from undulog.capture.common.arrays import BoolArray, FloatArray, IntArray
from undulog.capture.robot.kinematics import link_poses
from undulog.capture.robot.model import Robot

from ..samples.content import BodyPlaces
from ..samples.timeline import LoggedRhythm
from ..samples.tracks import Track, interpolate

DEGREES = np.rint(np.degrees(np.append(phases_rad(), 2 * np.pi))).astype(np.int64)
"""Phases of a mean cycle, the end again like the beginning [degrees], shape (p,)."""

_NS = 1e9


@dataclass(frozen=True)
class CyclePhase:
    """The gait's phase over the time window whose cycles are averaged.

    Attributes:
        t_ns: Times [ns], ascending, at most one sample beyond the stretch, shape (n,).
        phase_rad: Phase, always increasing, shape (n,).
        start_s: Start of the stretch, from the session's start [s].
        stop_s: Its end [s].
        ends_rad: Phase at its start and its end.
        logged: Whether the controller logged it; else it is 0 at the crest of the command of the
            joint that stands for the head.
    """

    t_ns: IntArray
    phase_rad: FloatArray
    start_s: float
    stop_s: float
    ends_rad: tuple[float, float]
    logged: bool

    @property
    def period_s(self) -> float:
        """Mean length of a cycle [s]."""
        turns = (self.ends_rad[1] - self.ends_rad[0]) / (2 * np.pi)
        return (self.stop_s - self.start_s) / turns

    def shortened(self, stop_s: float, start_ns: int) -> CyclePhase:
        """Return the pace up to an earlier end.

        Args:
            stop_s: Where it ends at the latest [s].
            start_ns: Unix time of the session's start [ns].

        Returns:
            The pace up to there; itself where it ends before.
        """
        if stop_s >= self.stop_s:
            return self
        stop_ns = start_ns + round(stop_s * _NS)
        j = int(np.searchsorted(self.t_ns, stop_ns)) + 1
        return replace(
            self,
            t_ns=self.t_ns[:j],
            phase_rad=self.phase_rad[:j],
            stop_s=stop_s,
            ends_rad=(self.ends_rad[0], float(np.interp(stop_ns, self.t_ns, self.phase_rad))),
        )


@dataclass(frozen=True)
class MeanCycles:
    """Mean cycles of k channels.

    Attributes:
        value: In the channels' unit, shape (k, p); the last phase is the first again.
        half: Half widths of the 95 % intervals, each phase by itself, NaN where one cycle is all
            there is, shape (k, p).
        cycles: Whole cycles averaged, shape (k,).
    """

    names: tuple[str, ...]
    value: FloatArray
    half: FloatArray
    cycles: IntArray

    def of(self, name: str) -> tuple[FloatArray, FloatArray]:
        """One channel.

        Returns:
            Value and half width, each of shape (p,).

        Raises:
            ValueError: If there is no such channel.
        """
        k = self.names.index(name)
        return self.value[k], self.half[k]

    def ordered(self, names: Sequence[str]) -> FloatArray:
        """Return values as columns in another order.

        Returns:
            Shape (p, number of names); NaN columns where there is no such channel.
        """
        columns = np.full((DEGREES.size, len(names)), np.nan)
        for i, name in enumerate(names):
            if name in self.names:
                columns[:, i] = self.of(name)[0]
        return columns


def pace_of(
    rhythm: LoggedRhythm | None,
    analysis: Analysis | None,
    *,
    commanded: Sequence[Track],
    places: BodyPlaces | None,
    start_ns: int,
) -> CyclePhase | None:
    """Return the time window that is averaged, and its phase.

    Args:
        rhythm: The logged phase, or None.
        analysis: The session's analysis; its window is taken where it has a gait.
        commanded: Commanded angles [rad], for the phase where none was logged.
        places: The joints that stand for the body.
        start_ns: Unix time of the session's start [ns].

    Returns:
        The pace, or None where there is neither a logged phase that runs on nor a gait, or not
        one whole cycle.
    """
    frequency = None if analysis is None else analysis.gait.frequency_hz.value
    window = None
    if analysis is not None and frequency is not None and analysis.gait.windows:
        window = analysis.gait.windows[0]
    if rhythm is None:
        if window is None or frequency is None or places is None:
            return None
        return _fitted(frequency, (window.start_s, window.stop_s), commanded, places, start_ns)
    t_s = (rhythm.t_ns - start_ns) / _NS
    first, last = (t_s[0], t_s[-1]) if window is None else (window.start_s, window.stop_s)
    i = max(int(np.searchsorted(t_s, first, side="right")) - 1, 0)
    j = int(np.searchsorted(t_s, last)) + 1
    phase = 2 * np.pi * rhythm.cycles[i:j]
    if phase.size < 2:
        return None
    phase = phase if phase[-1] >= phase[0] else -phase
    ends = _at(t_s[i:j], phase, float(first)), _at(t_s[i:j], phase, float(last))
    if not np.all(np.diff(phase) > 0) or ends[1] - ends[0] < 2 * np.pi - 1e-6:
        return None
    return CyclePhase(rhythm.t_ns[i:j], phase, float(first), float(last), ends, logged=True)


def falsified(analysis: Analysis | None, start_s: float, stop_s: float) -> tuple[str, ...]:
    """Return the joints whose measured angles are falsified by an artefact.

    Args:
        analysis: The session's analysis, or None.
        start_s: Start of a stretch, from the session's start [s].
        stop_s: Its end [s].

    Returns:
        Their names, each once.
    """
    artefacts = () if analysis is None else analysis.artefacts
    false = (artefact for artefact in artefacts if artefact.falsifies("position"))
    return tuple(
        dict.fromkeys(artefact.joint for artefact in false if artefact.within(start_s, stop_s))
    )


def mean_cycles(tracks: Sequence[Track], pace: CyclePhase) -> MeanCycles | None:
    """Return the mean cycles of channels.

    Args:
        tracks: The channels, each on its own times.

    Returns:
        Those of them that have a whole cycle; None where none has.
    """
    cuts = {track.name: _cut(track, pace) for track in tracks}
    cuts = {name: cut for name, cut in cuts.items() if len(cut)}
    if not cuts:
        return None
    return MeanCycles(
        tuple(cuts),
        np.array([_closed(cut.mean(axis=0)) for cut in cuts.values()]),
        np.array([_closed(_half(cut)) for cut in cuts.values()]),
        np.array([len(cut) for cut in cuts.values()]),
    )


def body_frame(robot: Robot, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the links in a frame that moves with the body.

    Its origin is the mean of the links' centres, its axes are their mean orientation (the rotation
    nearest to the mean of theirs), so that shapes lie over each other however the robot travels.

    Args:
        robot: The robot, m joints.
        angles: Joint angles [rad], shape (n, m).

    Returns:
        Link centres [m], shape (n, m + 1, 3), and rotations, shape (n, m + 1, 3, 3); NaN beyond
        a joint whose angle isn't known, and the frame is then that of the links before it.
    """
    still = np.zeros((len(angles), 3)), np.tile(np.eye(3), (len(angles), 1, 1))
    centre, rotation = link_poses(robot, *still, angles)
    finite = np.isfinite(centre[..., 0])
    many = np.count_nonzero(finite, axis=1)[:, None]
    middle = np.where(finite[..., None], centre, 0.0).sum(axis=1) / many
    u, _, vt = np.linalg.svd(np.where(finite[..., None, None], rotation, 0.0).sum(axis=1))
    # Det of U V^T is +1 or -1: only the former is a rotation.
    sign = np.ones((len(angles), 3))
    sign[:, 2] = np.linalg.det(u @ vt)
    frame = (u * sign[:, None, :]) @ vt
    turned = np.einsum("nji,nlj->nli", frame, centre - middle[:, None])
    return turned, np.einsum("nji,nljk->nlik", frame, rotation)


def _at(t_s: FloatArray, phase: FloatArray, at_s: float) -> float:
    """Return the phase at a time up to one sampling interval outside the samples."""
    k = int(np.clip(np.searchsorted(t_s, at_s), 1, t_s.size - 1))
    rate = (phase[k] - phase[k - 1]) / (t_s[k] - t_s[k - 1])
    return float(phase[k] + rate * (at_s - t_s[k]))


def _fitted(
    frequency_hz: float,
    window: tuple[float, float],
    commanded: Sequence[Track],
    places: BodyPlaces,
    start_ns: int,
) -> CyclePhase | None:
    """Return the phase of a fitted rhythm: 0 at the crest of the first joint's command."""
    track = next((track for track in commanded if track.name == places.names[0]), None)
    cycles = (window[1] - window[0]) * frequency_hz
    if track is None or not cycles <= track.t_ns.size:  # a saved result may say anything
        return None
    omega = 2 * np.pi * frequency_hz
    series = clean(track.name, track.t_ns, track.values, start_ns).between(*window)
    model = allowed_model([series], omega) if series.count > 1 else None
    if model is None or series.count <= model.size + 1:
        return None
    crest = float(np.angle(fit_at([series], omega, model).fundamental[0]))
    at_s = np.linspace(*window, 2 + int(cycles * PHASES))
    ends = omega * window[0] + crest, omega * window[1] + crest
    at_ns = start_ns + np.round(at_s * _NS).astype(np.int64)
    return CyclePhase(at_ns, omega * at_s + crest, *window, ends, logged=False)


def _cut(track: Track, pace: CyclePhase) -> FloatArray:
    """Return a channel's whole cycles, shape (c, ``PHASES``)."""
    phase = interpolate(pace.t_ns, pace.phase_rad, track.t_ns)
    finite: BoolArray = np.isfinite(phase) & np.isfinite(track.values)
    phase, values = phase[finite], track.values[finite]
    first = np.append(True, np.diff(phase) > 0) if phase.size else finite[:0]
    series = Series(track.name, phase[first], values[first])
    nothing = np.zeros((0, PHASES))
    if series.count < 3:
        return nothing
    model = allowed_model([series], 1.0)
    if series.count <= model.size + 1 or 4 * series.period_s > np.pi:
        return nothing
    fit, (start, stop) = fit_at([series], 1.0, model), pace.ends_rad
    return cycles_by_phase(series, fit, 0, zero_rad=0.0, start_s=start, stop_s=stop)


def _half(cut: FloatArray) -> FloatArray:
    """Half widths of the 95 % intervals of the mean of c cycles, shape (``PHASES``,)."""
    if len(cut) == 1:
        return np.full(PHASES, np.nan)
    runs = from_runs(cut)
    return t_factor(float(runs.dof[0])) * np.sqrt(runs.variance)


def _closed(values: FloatArray) -> FloatArray:
    return np.append(values, values[0])
