"""From the cycles of several sessions to how shape moves the body, each session held out once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.errors import DataError

from ..common import formats
from ..common.estimate import Estimate
from ..estimators.intervals import around
from ..parts.body.connection import Connection, condition_of, distances, fit_connection
from ..parts.body.result import ShapeMode
from ..parts.body.travel import GaitCycle, mean_step, wave_at
from ..results.body_connection import BodyConnection, ConnectionEntry, PredictedTravel

MOST_DISTANCE = 0.3
"""A gait whose joints differ from the central one by more than this share is another gait."""

SAME_SPEED = 1.05
"""Ratio of a gait's frequency to those of the model up to which intervals hold without inertia."""

MOST_SPEED = 2 * SAME_SPEED
"""The same up to which a value is predicted, but without an interval."""

SPEED_IN_MODEL = 1.5 * SAME_SPEED
"""Ratio of the frequency of a gait of the model to the median, at most."""

_VELOCITIES = ("forward", "left", "turn")
_PHASES: FloatArray = 2 * np.pi * np.arange(24) / 24

CONNECTION_METHOD = (
    "velocity of the body xi = A r' + B (r - r0) in the axes of the virtual chassis, A and B "
    "Fourier series in the gait's phase, least squares over the mean cycles of all gaits; each "
    "session predicted from its measured joint angles by a model of the others; intervals at 95 % "
    "from what the gaits leave when left out (Student's t), none at another speed."
)
"""The method as one sentence, beginning in lower case."""


@dataclass(frozen=True)
class GaitSession:
    """One session with its cycle."""

    path: str
    cycle: GaitCycle


def body_connection(
    sessions: Sequence[GaitSession | None],
) -> tuple[BodyConnection | None, dict[int, str]]:
    """Fit the model to sessions of one gait and its perturbations.

    Args:
        sessions: In the experiment's order; None without a cycle of the body.

    Returns:
        The model, or the reason why there is none; None where no session has a cycle. And by index
        why a session has no part in it.
    """
    gaits = {k: session for k, session in enumerate(sessions) if session is not None}
    if not gaits:
        return None, {}
    why = dict.fromkeys(
        (k for k, session in enumerate(sessions) if session is None),
        "has no planar gait with the head's pose and all joint angles",
    )
    joints = next(iter(gaits.values())).cycle.joints
    other = {k: "has other joints" for k, gait in gaits.items() if gait.cycle.joints != joints}
    seen: dict[bytes, int] = {}
    for k, gait in gaits.items():
        first = seen.setdefault(gait.cycle.shape.tobytes(), k)
        if first != k:
            other[k] = "is a copy of another session"
    used = [k for k in gaits if k not in other]
    off = distances([gaits[k].cycle for k in used])
    far = {
        k: f"is another gait: its joint angles differ from the central one by {100 * share:.0f} %"
        for k, share in zip(used, off.tolist(), strict=True)
        if share > MOST_DISTANCE
    }
    near = [k for k in used if k not in far]
    middle = float(np.median([gaits[k].cycle.omega for k in near]))
    fast = {
        k: f"has another speed: its frequency is {factor:.3g} times the median of the sessions"
        for k in near
        if not 1 / SPEED_IN_MODEL <= (factor := gaits[k].cycle.omega / middle) <= SPEED_IN_MODEL
    }
    inside = [k for k in near if k not in fast]
    result = _result({k: gaits[k] for k in used}, inside)
    return result, why | other | far | fast


def _result(sessions: dict[int, GaitSession], inside: Sequence[int]) -> BodyConnection:
    cycles = [sessions[k].cycle for k in inside]
    number = condition_of(cycles)
    condition = number if np.isfinite(number) else None
    try:
        model = fit_connection(cycles)
    except DataError as error:
        return BodyConnection(False, str(error), len(cycles), condition)
    base = model.base
    shape = base.modes.T @ base.mean.reshape(-1, 1) + wave_at(base.cycle, _PHASES)
    modes = zip(base.share.tolist(), base.modes.T.tolist(), strict=True)
    return BodyConnection(
        fitted=True,
        why=f"{len(cycles)} gaits around one gait",
        gaits=len(cycles),
        condition_number=condition,
        identified=model.identified,
        joints=cycles[0].joints,
        modes=tuple(ShapeMode(Estimate(share), tuple(weights)) for share, weights in modes),
        phase_rad=tuple(_PHASES.tolist()),
        shape_rad=tuple(tuple(row) for row in shape.tolist()),
        A=_entries(model) if model.identified else (),
        predicted=tuple(_held_out(sessions, inside, model, k) for k in sessions),
    )


def _entries(model: Connection) -> tuple[ConnectionEntry, ...]:
    value, half = model.matrices(_PHASES)
    return tuple(
        ConnectionEntry(name, k + 1, tuple(value[:, c, k].tolist()), tuple(half[:, c, k].tolist()))
        for c, name in enumerate(_VELOCITIES)
        for k in range(value.shape[2])
    )


def _held_out(
    sessions: dict[int, GaitSession], inside: Sequence[int], model: Connection, index: int
) -> PredictedTravel:
    """Predict a session from the others."""
    session, nothing = sessions[index], Estimate()
    cycle = session.cycle
    forward, left, turn = map(mean_step, cycle.steps.T)
    measured = PredictedTravel(
        *(session.path, cycle.omega / (2 * np.pi)),
        *(nothing, nothing, nothing),
        *(forward, left, turn),
    )
    others = [sessions[k].cycle for k in inside if k != index]
    ratio = _speed_ratio(cycle, others)
    try:
        if index in inside:
            model = fit_connection(others)
        why = model.outside(cycle.shape)
    except DataError as error:
        why = f"without it: {error}"
    if why is None and ratio > MOST_SPEED:
        why = (
            f"its frequency is outside that of the model's gaits by a factor of {ratio:.3g}, of "
            f"which at most {MOST_SPEED:g} is allowed: inertia is not in the model"
        )
    if why is not None:
        return replace(measured, why=why)
    value, half = model.predict(cycle.shape)
    forward, left, turn = (
        Estimate(step, around(step, width) if ratio <= SAME_SPEED else None)
        for step, width in zip(value.tolist(), half.tolist(), strict=True)
    )
    return replace(measured, forward_m=forward, left_m=left, turn_rad=turn)


def _speed_ratio(cycle: GaitCycle, others: Sequence[GaitCycle]) -> float:
    """Return by which factor a gait's frequency is outside the others', 1 or less if inside."""
    omega = [other.omega for other in others]
    return max(cycle.omega / max(omega), min(omega) / cycle.omega)


def connection_answer(connection: BodyConnection) -> str:
    """Answer from the model in one sentence without its full stop."""
    travels = [travel for travel in connection.predicted if travel.why is None]
    lead = f"how shape moves the body, from {connection.why} (effective, first order)"
    if not travels:
        return f"{lead}: no session is within the range of the others, so none is predicted"
    distance = [
        (np.hypot(_of(travel.forward_m), _of(travel.left_m)), _gone(travel)) for travel in travels
    ]
    off = float(np.median([abs(a - b) for a, b in distance]))
    gone = float(np.median([b for _, b in distance]))
    turn = [abs(_of(travel.turn_rad) - _of(travel.measured_turn_rad)) for travel in travels]
    outside = len(connection.predicted) - len(travels)
    rest = f"; {outside} outside the range of the others" if outside else ""
    return (
        f"{lead}: each of {len(travels)} sessions predicted from the others, median error of a "
        f"cycle's displacement {formats.number(1000 * off, 1)} mm of "
        f"{formats.number(1000 * gone, 0)} mm, of its turn "
        f"{formats.number(float(np.degrees(np.median(turn))), 2)}°{rest}"
    )


def _of(estimate: Estimate) -> float:
    return estimate.value or 0.0


def _gone(travel: PredictedTravel) -> float:
    return float(np.hypot(_of(travel.measured_forward_m), _of(travel.measured_left_m)))


def connection_detail(connection: BodyConnection) -> list[str]:
    """Return sentences on the modes and what is identified."""
    shares = ", ".join(f"{100 * _of(mode.share):.2g} %" for mode in connection.modes)
    number = (
        "infinite" if connection.condition_number is None else f"{connection.condition_number:.3g}"
    )
    if connection.identified:
        verdict = "the connection A is identified (--json)"
    else:
        verdict = (
            "the connection A itself is not identified, only what perturbations of these kinds do"
        )
    modes = f"Shape modes with {shares} of the variance of all shapes"
    lines = [
        f"{modes}; condition number {number}: {verdict}.",
        formats.sentence(f"the model is {connection.label}"),
    ]
    bare = sum(
        travel.why is None and travel.forward_m.ci95 is None for travel in connection.predicted
    )
    if bare:
        lines.append(
            f"No interval for {bare} of the predictions: the gait's frequency is more than "
            f"{100 * (SAME_SPEED - 1):.0f} % outside that of the others, and inertia is not in "
            "the model."
        )
    return lines
