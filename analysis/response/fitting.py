"""From the commands and responses of a stretch to one fitted gait."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import IntArray
from undulog.capture.common.console import Warn

from ..common.answer import percent
from ..common.remarks import Lacking, Note
from ..estimators.harmonic import LINEAR, HarmonicFit, fit_at, fit_shared
from ..estimators.series import Series
from ..estimators.spectrum import (
    FundamentalNoise,
    omega_variance,
    residual_noise,
    residual_spectrum,
)
from ..estimators.turning import turning_beside_others
from .changes import (
    MOVING,
    Pace,
    ResponseChanges,
    moving_pace,
    response_changes,
    with_changes,
)
from .gait_warnings import warn_changes, warn_groups, warn_undriven
from .groups import (
    Groups,
    find_groups,
    group_model,
    with_mixed_lines,
)
from .response import Response, respond
from .rhythm import (
    HARMONICS,
    MIN_CYCLES,
    MIN_EXPLAINED,
    MIN_SAMPLES,
    NYQUIST_SHARE,
    Rhythm,
    allowed_model,
    driven,
    find_rhythm,
)
from .without_gait import warn_no_gait

_CLEAR = 0.95
"""Commands explained to less than this are not one steady rhythm, if still a gait."""

_PACE_ROUNDS = 3
"""Of following a frequency that moves; the second is a correction."""

_CORRECTED = 1e-2

_ROUNDS = 10
"""Of fitting several groups in turn; exact commands need one, noisy ones two or three."""


@dataclass(frozen=True)
class GaitFit:
    """One gait, fitted to all its channels with a shared frequency.

    Where joints have several frequencies, it is the largest group's, and holds the others.

    Attributes:
        fit: Commands of the ``driven`` joints, then responses of the ``answered`` ones.
        omega_error: Standard error of the shared frequency [rad/s].
        driven: Names of the joints that the gait drives, head to tail.
        answered: Those of them with a usable response.
        response: Of the ``answered`` joints.
        command_amplitudes: By joint name, also of joints that are not driven and of the other
            groups [rad].
        changes: How the responses change from cycle to cycle; None where that is unknown.
        pace: How the frequency moves; None where it stays.
        others: Fits of the other groups, the larger first; they hold none themselves.
    """

    fit: HarmonicFit
    omega_error: float
    omega_dof: float
    driven: tuple[str, ...]
    answered: tuple[str, ...]
    response: Response | None
    command_amplitudes: Mapping[str, float]
    changes: ResponseChanges | None = None
    pace: Pace | None = None
    others: tuple[GaitFit, ...] = ()

    @property
    def groups(self) -> tuple[GaitFit, ...]:
        """The fits of all groups, the largest first."""
        return (replace(self, others=()), *self.others)

    @property
    def all_answered(self) -> tuple[str, ...]:
        """Names of the driven joints of all groups with a usable response, group by group."""
        return tuple(name for group in (self, *self.others) for name in group.answered)

    def group_of(self, joint: str) -> int | None:
        """Find the group that a joint is in.

        Returns:
            The group's index in ``groups``; None where the gait does not drive the joint.
        """
        for index, group in enumerate((self, *self.others)):
            if joint in group.driven:
                return index
        return None


@dataclass(frozen=True)
class _Channels:
    """The channels of one group: commands of the driven joints, responses of the answered ones."""

    driven: tuple[str, ...]
    answered: tuple[str, ...]
    series: list[Series]


def fit_gait(
    commands: Mapping[str, Series], responses: Mapping[str, Series], duration_s: float, warn: Warn
) -> GaitFit | None:
    """Fit the gait of a stretch.

    Args:
        commands: By joint name, in chain order.
        duration_s: Length of the stretch [s].
        warn: Takes one sentence for each thing that is missing or doubtful.

    Returns:
        The fit, or None, with a warning that says why, where there is no gait.
    """
    commands = _swinging(commands, warn)
    leading = list((commands or responses).values())
    kind = "commands" if commands else "responses"
    if commands:
        grouping = find_groups(leading, duration_s)
    else:  # through the body each response has the tones of all groups
        rhythm = find_rhythm(leading, duration_s)
        grouping = None if rhythm is None else Groups((rhythm,), rhythm.explained)
    if grouping is None or grouping.explained < MIN_EXPLAINED:
        warn_no_gait(leading, grouping, kind, duration_s, warn)
        return None
    if not commands:
        return _responses_only(responses, grouping.rhythms[0])
    channels, amplitudes = _select(commands, responses, grouping, warn)
    rhythms = [
        rhythm for rhythm, group in zip(grouping.rhythms, channels, strict=True) if group.driven
    ]
    channels = [group for group in channels if group.driven]
    if not channels:
        warn(Lacking("no gait: no joint has enough commands at the frequency that they share"))
        return None
    fits = _fit_groups(channels, [rhythm.omega for rhythm in rhythms], duration_s)
    warn_groups(grouping, fits, duration_s, warn)
    groups = [
        _group_fit(group, fit, amplitudes, warn) for group, fit in zip(channels, fits, strict=True)
    ]
    return replace(groups[0], others=tuple(groups[1:]))


def _swinging(commands: Mapping[str, Series], warn: Warn) -> Mapping[str, Series]:
    """Return the commands without those that turn without end beside others."""
    turning = turning_beside_others({name: command.values for name, command in commands.items()})
    if turning:
        turn = "turns" if len(turning) == 1 else "turn"
        warn(Note(f"{', '.join(turning)} {turn} without end: gain and lag are null"))
    return {name: command for name, command in commands.items() if name not in turning}


def _select(
    commands: Mapping[str, Series], responses: Mapping[str, Series], groups: Groups, warn: Warn
) -> tuple[list[_Channels], dict[str, float]]:
    """Return the channels of each group's driven joints, and the amplitudes of all commands."""
    several = len(groups.rhythms) > 1
    least = max(MIN_SAMPLES, 2 * HARMONICS * len(groups.rhythms) + 2 if several else 0)
    group_of = {name: k for k, rhythm in enumerate(groups.rhythms) for name in rhythm.names}

    def enough(name: str, series: Series) -> bool:
        return _usable(series, groups.rhythms[group_of.get(name, 0)].omega, least)

    usable = {name: command for name, command in commands.items() if enough(name, command)}
    amplitudes = dict.fromkeys(usable, 0.0)
    strays = set(groups.astray)
    followers: set[str] = set()
    silent: list[str] = []
    channels: list[_Channels] = []
    for rhythm in groups.rhythms:
        moving = [command for name, command in usable.items() if name in rhythm.names]
        if not moving:
            channels.append(_Channels((), (), []))
            continue
        first = rhythm.fit
        if len(moving) < len(rhythm.names):
            model = replace(allowed_model(moving, rhythm.omega), lines=first.model.lines)
            first = fit_at(moving, rhythm.omega, model)
        follows, astray = driven(first)
        sizes = np.abs(first.fundamental).tolist()
        amplitudes |= zip((command.name for command in moving), sizes, strict=True)
        chosen = [command for command, follow in zip(moving, follows, strict=True) if follow]
        strays |= {command.name for command, stray in zip(moving, astray, strict=True) if stray}
        moved = tuple(command.name for command in chosen)
        followers |= set(moved)
        answered = tuple(n for n in moved if n in responses and enough(n, responses[n]))
        silent += [name for name in moved if name in responses and name not in answered]
        channels.append(_Channels(moved, answered, chosen + [responses[n] for n in answered]))
    unresolved = {name for close in groups.unresolved for name in close.left}
    warn_undriven(
        held=[name for name in usable if name not in strays | followers | unresolved],
        astray=[name for name in usable if name in strays],
        unusable=[name for name in commands if name not in usable],
        warn=warn,
    )
    if silent:
        warn(f"too few response samples for {', '.join(silent)}: gain and lag are null")
    return channels, amplitudes


def _fit_groups(
    channels: Sequence[_Channels], omegas: Sequence[float], duration_s: float
) -> list[HarmonicFit]:
    """Fit each group with the tones of all; several in turn until no frequency moves.

    The parameters of all groups are then at the common least-squares optimum, since each group's
    normal equations, given the others' frequencies, contain the others' amplitudes.
    """
    omegas = list(omegas)
    fits: list[HarmonicFit] = []
    mixed: list[tuple[float, ...]] = []
    for k, group in enumerate(channels):
        model = group_model(group.series, omegas, k, duration_s)
        responses = group.series[len(group.driven) :]
        if len(channels) > 1 and responses:
            wider = with_mixed_lines(responses, omegas, k, model, duration_s)
            mixed.append(wider.lines[len(model.lines) :])
        else:
            mixed.append(())
    for _ in range(_ROUNDS):
        fits = []
        for k, group in enumerate(channels):
            model = group_model(group.series, omegas, k, duration_s)
            model = replace(model, lines=(*model.lines, *mixed[k]))
            fits.append(fit_shared(group.series, omegas[k], model))
        moved = [abs(fit.omega - omega) for fit, omega in zip(fits, omegas, strict=True)]
        omegas = [fit.omega for fit in fits]
        if len(channels) == 1 or max(moved) * duration_s < LINEAR:
            break
    return fits


def _group_fit(
    group: _Channels, fit: HarmonicFit, amplitudes: Mapping[str, float], warn: Warn
) -> GaitFit:
    """Return the response of a group's joints, with its noise."""
    moved, answered, channels = group.driven, group.answered, group.series
    noise, bins = residual_spectrum(channels, fit)
    variance, dof = omega_variance(fit, noise)
    commanded = np.array([moved.index(name) for name in answered], dtype=np.int64)
    responded = np.arange(len(moved), len(channels))
    pace, paced, paced_fit = _paced(channels, len(moved), fit)
    explained = 1 - float(paced_fit.rss[: len(moved)].sum() / paced_fit.total[: len(moved)].sum())
    if explained < _CLEAR:
        share = percent(explained, _CLEAR)
        warn(
            f"one steady rhythm explains {share} of the commands' variance: gain "
            "and lag are averages over what changes"
        )
    if not answered:
        return GaitFit(fit, variance**0.5, dof, moved, answered, None, amplitudes, None, pace)
    if pace is not None:
        noise, bins = residual_spectrum(paced, paced_fit)
    response = respond(
        paced_fit.fundamental[commanded],
        _pick(noise, commanded),
        paced_fit.fundamental[responded],
        _pick(noise, responded),
        omega_variance=variance if pace is None else omega_variance(paced_fit, noise)[0],
        delay_between_s=paced_fit.mean_time_s[responded] - paced_fit.mean_time_s[commanded],
        bins=(bins.select(commanded), bins.select(responded)),
    )
    changes = response_changes(
        [paced[moved.index(name)] for name in answered],
        paced[len(moved) :],
        paced_fit,
        np.stack([commanded, responded]),
    )
    if changes is not None:
        response = with_changes(response, changes)
    warn_changes(changes, pace, answered, warn)
    return GaitFit(fit, variance**0.5, dof, moved, answered, response, amplitudes, changes, pace)


def _paced(
    channels: list[Series], commands: int, fit: HarmonicFit
) -> tuple[Pace | None, list[Series], HarmonicFit]:
    """Take the channels over the phase of the commands, where their frequency moves."""
    paced: Pace | None = None
    if fit.model.lines:
        return paced, channels, fit  # a group whose frequency moves has no constant lines
    for _ in range(_PACE_ROUNDS):
        least = MOVING if paced is None else _CORRECTED * MOVING
        pace = moving_pace(channels, commands, fit, least)
        if pace is None:
            break
        before = 0.0 if paced is None else paced.drift
        channels = pace.series
        turned = fit_shared(channels, fit.omega, fit.model)
        # The bent time stays as it is, whatever frequency is then found over it.
        paced = replace(pace, drift=(before + pace.drift) * turned.omega / fit.omega)
        fit = turned
    return paced, channels, fit


def _responses_only(responses: Mapping[str, Series], rhythm: Rhythm) -> GaitFit:
    usable = [response for response in responses.values() if _usable(response, rhythm.omega)]
    moving = [response for response in usable if np.ptp(response.values) > 0]
    fit = fit_shared(moving, rhythm.omega, allowed_model(moving, rhythm.omega))
    variance, dof = omega_variance(fit, residual_noise(moving, fit))
    return GaitFit(fit, variance**0.5, dof, (), (), None, {})


def fit_at_period(
    responses: Mapping[str, Series], period_s: float, duration_s: float, warn: Warn
) -> GaitFit | None:
    """Fit a motion without commands at a period that the user states, however it wanders.

    Args:
        responses: By joint name, in chain order.
        duration_s: Length of the window [s].
        warn: Receives what the period explains.

    Returns:
        The fit; None, with a warning, where the window is too short or sampled too seldom for it.
    """
    omega = 2 * np.pi / period_s
    moving = [
        response
        for response in responses.values()
        if _usable(response, omega) and np.ptp(response.values) > 0
    ]
    if not moving or duration_s < MIN_CYCLES * period_s:
        warn(
            Lacking(
                f"no gait: no joint moves for {MIN_CYCLES:g} cycles of the stated period of "
                f"{period_s:g} s, with {1 / NYQUIST_SHARE:.2g} samples a cycle"
            )
        )
        return None
    fit = fit_at(moving, omega, allowed_model(moving, omega))
    _, dof = omega_variance(fit, residual_noise(moving, fit))
    share = f"{100 * max(1 - float(fit.rss.sum() / fit.total.sum()), 0.0):.0f} %"
    warn(
        f"the period of {period_s:g} s is stated, not found: mean cycles at it explain {share} of "
        "the motion's variance; amplitudes are smaller than those of single cycles where it wanders"
    )
    return GaitFit(fit, 0.0, dof, (), (), None, {})


def _usable(series: Series, omega: float, least: int = MIN_SAMPLES) -> bool:
    """Enough samples, often enough, for long enough."""
    if series.count <= least:
        return False
    cycles = omega * float(series.t_s[-1] - series.t_s[0] + series.period_s) / (2 * np.pi)
    return series.period_s * omega / (2 * np.pi) < NYQUIST_SHARE and cycles >= MIN_CYCLES - 0.01


def _pick(noise: FundamentalNoise, index: IntArray) -> FundamentalNoise:
    return FundamentalNoise(noise.level[index], noise.dof[index], noise.covariance[index])
