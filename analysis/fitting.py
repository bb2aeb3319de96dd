"""From the commands and responses of a stretch to one fitted gait."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .estimators.harmonic import HarmonicFit, fit_at, fit_shared
from .estimators.series import Series
from .estimators.settling import worst_drift
from .estimators.spectrum import Noise, omega_variance, residual_noise
from .gait import (
    MIN_CYCLES,
    MIN_EXPLAINED,
    MIN_SAMPLES,
    NYQUIST_SHARE,
    Rhythm,
    allowed_model,
    driven,
    find_rhythm,
)
from .reading import Warn
from .remarks import Lacking, Note
from .response import Response, respond

_CLEAR = 0.95
"""Commands explained to less than this are not one steady rhythm, if still a gait."""


@dataclass(frozen=True)
class GaitFit:
    """One gait, fitted to all its channels with a shared frequency.

    Attributes:
        fit: Commands of the ``driven`` joints, then responses of the ``answered`` ones.
        omega_error: Standard error of the shared frequency [rad/s].
        omega_dof: Its degrees of freedom.
        driven: Names of the joints that the gait drives, head to tail.
        answered: Those of them with a usable response.
        response: Of the ``answered`` joints.
        command_amplitudes: By joint name, also of joints that are not driven [rad].
    """

    fit: HarmonicFit
    omega_error: float
    omega_dof: float
    driven: tuple[str, ...]
    answered: tuple[str, ...]
    response: Response | None
    command_amplitudes: Mapping[str, float]

    def command_of(self, joint: str) -> int:
        """Index of a driven joint's command in the fit.

        Args:
            joint: Its name.

        Returns:
            The index.
        """
        return self.driven.index(joint)


def fit_gait(
    commands: Mapping[str, Series], responses: Mapping[str, Series], duration_s: float, warn: Warn
) -> GaitFit | None:
    """Fit the gait of a stretch.

    Args:
        commands: By joint name, in chain order.
        responses: By joint name.
        duration_s: Length of the stretch [s].
        warn: Takes one sentence for each thing that is missing or doubtful.

    Returns:
        The fit, or None, with a warning that says why, where there is no gait.
    """
    known = list((commands or responses).values())
    kind = "commands" if commands else "responses"
    rhythm = find_rhythm(known, duration_s)
    if rhythm is None or rhythm.explained < MIN_EXPLAINED:
        warn(Lacking(_no_gait(known, rhythm, kind, duration_s)))
        return None
    if not commands:
        return _responses_only(responses, rhythm)
    usable = {name: one for name, one in commands.items() if _usable(one, rhythm.omega)}
    moving = [one for name, one in usable.items() if name in rhythm.names]
    first = rhythm.fit
    if len(moving) < len(rhythm.names):
        first = fit_at(moving, rhythm.omega, allowed_model(moving, rhythm.omega))
    follows, astray = driven(first)
    amplitudes = dict.fromkeys(usable, 0.0)
    amplitudes |= zip((one.name for one in moving), np.abs(first.fundamental).tolist(), strict=True)
    chosen = [one for one, follow in zip(moving, follows, strict=True) if follow]
    strays = {one.name for one, stray in zip(moving, astray, strict=True) if stray}
    followers = {one.name for one in chosen}
    _warn_undriven(
        held=[name for name in usable if name not in strays | followers],
        astray=[name for name in usable if name in strays],
        unusable=[name for name in commands if name not in usable],
        warn=warn,
    )
    moved = tuple(one.name for one in chosen)
    answered = tuple(n for n in moved if n in responses and _usable(responses[n], rhythm.omega))
    silent = [name for name in moved if name in responses and name not in answered]
    if silent:
        warn(f"too few response samples for {', '.join(silent)}: gain and lag are null")
    channels = chosen + [responses[name] for name in answered]
    fit = fit_shared(channels, rhythm.omega, allowed_model(channels, rhythm.omega))
    noise = residual_noise(channels, fit)
    variance, dof = omega_variance(fit, noise)
    commanded = np.array([moved.index(name) for name in answered], dtype=np.int64)
    responded = np.arange(len(moved), len(channels))
    explained = 1 - float(fit.rss[: len(moved)].sum() / fit.total[: len(moved)].sum())
    if explained < _CLEAR:
        warn(
            f"one steady rhythm explains {100 * explained:.0f} % of the commands' variance: gain "
            "and lag are averages over what changes"
        )
    response = None
    if answered:
        response = respond(
            fit.fundamental[commanded],
            _pick(noise, commanded),
            fit.fundamental[responded],
            _pick(noise, responded),
            omega_variance=variance,
            delay_between_s=fit.mean_time_s[responded] - fit.mean_time_s[commanded],
        )
        drift = worst_drift(channels[len(moved) :], fit, responded.tolist())
        if drift is not None:
            warn(
                f"not settled: the response of {drift.name} drifts by "
                f"{100 * drift.log_gain:+.2g} % in gain and "
                f"{np.degrees(-drift.phase_rad):+.2g} degrees of lag per cycle, more than any "
                "other; start later (--start)"
            )
    return GaitFit(fit, variance**0.5, dof, moved, answered, response, amplitudes)


def _responses_only(responses: Mapping[str, Series], rhythm: Rhythm) -> GaitFit:
    usable = [one for one in responses.values() if _usable(one, rhythm.omega)]
    moving = [one for one in usable if np.ptp(one.values) > 0]
    fit = fit_shared(moving, rhythm.omega, allowed_model(moving, rhythm.omega))
    variance, dof = omega_variance(fit, residual_noise(moving, fit))
    return GaitFit(fit, variance**0.5, dof, (), (), None, {})


def _usable(one: Series, omega: float) -> bool:
    """Enough samples, often enough, for long enough."""
    if one.count <= MIN_SAMPLES:
        return False
    cycles = omega * float(one.t_s[-1] - one.t_s[0] + one.period_s) / (2 * np.pi)
    return one.period_s * omega / (2 * np.pi) < NYQUIST_SHARE and cycles >= MIN_CYCLES - 0.01


def _pick(noise: Noise, index: np.ndarray[tuple[int], np.dtype[np.int64]]) -> Noise:
    return Noise(noise.level[index], noise.dof[index], noise.covariance[index])


def _warn_undriven(*, held: list[str], astray: list[str], unusable: list[str], warn: Warn) -> None:
    """Say once why joints have no gain and lag."""
    reasons = (
        (held, "held still by the command"),
        (astray, "commanded something else than the common rhythm"),
        (unusable, "commanded too seldom or too briefly"),
    )
    for joints, why in reasons:
        if joints:
            count = f"{len(joints)} joints are" if len(joints) > 1 else "1 joint is"
            told = f"{count} {why}, gain and lag are null: {', '.join(joints)}"
            warn(Note(told) if joints is held else told)


def _no_gait(known: list[Series], rhythm: Rhythm | None, kind: str, duration_s: float) -> str:
    nulls = "gain, lag and frequency are null"
    if not known or all(one.count < 2 or np.ptp(one.values) == 0 for one in known):
        return f"no gait: the {kind} never move; {nulls}"
    if rhythm is None:
        return (
            f"no gait: no rhythm of at least {MIN_CYCLES:g} cycles can be told from the {kind} in "
            f"{duration_s:.3g} s; {nulls}"
        )
    return (
        f"no gait: the best rhythm ({rhythm.omega / (2 * np.pi):.3g} Hz) explains "
        f"{100 * max(rhythm.explained, 0):.0f} % of the {kind}' variance, a gait at least "
        f"{100 * MIN_EXPLAINED:.0f} %; {nulls} (if only part of the session is a gait, choose it "
        "with --start and --stop)"
    )
