"""Test of a session against a model of identical modules."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from . import formats
from .analysis import Analysis
from .estimate import Estimate, leaves_out_zero

SIGNIFICANT = 0.05
"""Family-wise level at which a module is named."""


@dataclass(frozen=True)
class SharedEstimate:
    """A parameter that all modules share, fitted to the session.

    Attributes:
        name: For example ``stall_torque``.
        unit: SI.
        assumed: The model's value.
        fitted: The session's, with its 95 % interval.
        within: Whether it lies where the model holds.
    """

    name: str
    unit: str
    assumed: float
    fitted: Estimate
    within: bool


@dataclass(frozen=True)
class ModuleDeviation:
    """One module's own parameters against what all modules share.

    The intervals of all modules hold together at 95 %, each for that module alone deviating beside
    those that are named.

    Attributes:
        named: Whether it is shown to deviate.
        gain: Lambda: by how much Q falls if it deviates.
        relative: Kind, e.g. ``stall_torque``, to own value / shared value - 1.
    """

    name: str
    named: bool
    gain: float
    p: float
    relative: dict[str, Estimate]


@dataclass(frozen=True)
class NullModelResult:
    """H1, identical modules, and H2, one of them deviates, from one direction alone.

    Attributes:
        condition: What all of it rests on.
        made_by: What the model was made from.
        parameters: Shared by all modules, as fitted.
        fit: Q1, of identical modules.
        fit_p: p-value of Q1.
        p: p-value of identical modules against one that deviates, family-wise.
        named: Joints whose modules deviate, the clearest first.
        rest_p: p-value of what the named ones leave.
    """

    answer: str
    condition: str
    file: str
    made_by: str
    parameters: tuple[SharedEstimate, ...]
    fit: float
    fit_p: float
    p: float
    modules: tuple[ModuleDeviation, ...]
    named: tuple[str, ...]
    rest_p: float
    draws: int


@dataclass(frozen=True)
class ModelledAnalysis(Analysis):
    """The numbers of one session, and what a null model makes of them."""

    null_model: NullModelResult = field(kw_only=True)


def null_answer(modules: list[ModuleDeviation], named: list[str], p: float, fit_p: float) -> str:
    """Return the answer in one sentence.

    Args:
        named: Those that deviate, the clearest first.
        p: Of identical modules against one that deviates.
        fit_p: Of identical modules against anything.

    Returns:
        Without its full stop, intervals in square brackets.
    """
    if named:
        first = next(one for one in modules if one.name == named[0])
        clear = {kind: e for kind, e in first.relative.items() if leaves_out_zero(e.ci95)}
        shown = (clear or first.relative).items()
        own = ", ".join(f"{_words(kind)} {formats.percent(one)}" for kind, one in shown)
        also = f"; then {', '.join(named[1:])}" if len(named) > 1 else ""
        return f"{first.name} deviates: {own} ({formats.p_value_text(p)}){also}"
    if fit_p < SIGNIFICANT:
        return (
            f"neither identical modules nor a single one that deviates explain this session "
            f"(fit {formats.p_value_text(fit_p)}): the model is not of this robot, ground or gait"
        )
    bounds: list[str] = []
    for kind in modules[0].relative:
        ends = [abs(end) for one in modules for end in one.relative[kind].ci95 or (math.inf,)]
        if max(ends) < 1:  # more than that is no bound
            bounds.append(f"{100 * max(ends):.2g} % in {_words(kind)}")
    bound = f": none by more than {', '.join(bounds)}" if bounds else ", nor any bound on it"
    return f"no module is shown to deviate ({formats.p_value_text(p)}){bound}"


def null_model_text(result: NullModelResult) -> list[str]:
    """Return lines for a terminal.

    Returns:
        The answer first, the parameters last.
    """
    shared = ", ".join(
        f"{_words(one.name)} {formats.estimate(one.fitted)} {one.unit} (model {one.assumed:.4g})"
        for one in result.parameters
    )
    return [
        f"Modules, {result.condition}: {result.answer}.",
        f"Shared by all modules: {shared}; fit {formats.p_value_text(result.fit_p)}.",
    ]


def _words(name: str) -> str:
    return name.replace("_", " ")
