"""Results of comparisons, with other sessions and with a null model: frozen values.

``Comparison.to_dict`` is the object that ``undulog compare A B --json`` prints. Differences are B
minus A. What could not be computed is None (null), and ``warnings`` says why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ..common import formats
from ..common.estimate import Estimate, PresentedResult, Provenance, leaves_out_zero
from .analysis import Analysis, SessionFacts

BODY = "body"
"""Where a difference is that belongs to no joint."""

SIGNIFICANT = 0.05
"""Family-wise level at which a module is named."""


def of_body(place: str) -> bool:
    """Return whether a place is the body, or one of its planes: ``body, yaw``."""
    return place == BODY or place.startswith(f"{BODY}, ")


@dataclass(frozen=True)
class MetadataChange:
    """One thing that the sessions say of themselves, and say otherwise.

    Attributes:
        name: For example ``scenario.toml: servo_of.joint03.stall_torque``.
        a: On side A, or None where it is not there.
    """

    name: str
    a: str | None
    b: str | None


@dataclass(frozen=True)
class Difference:
    """One quantity of one joint, or of the body, on both sides.

    Attributes:
        quantity: ``gain``, ``lag`` [rad], ``offset`` (mean of the position less that of its
            command), ``energy_abs``, ``speed`` or ``cost_of_transport``; of joints whose commands
            are no gait ``delay`` [s] instead of ``lag``; of sessions
            without commands ``amplitude``, ``phase_lag`` (behind the joint before it in its plane),
            ``rest_amplitude`` (of a joint that moves in some sessions only), ``frequency``,
            ``wave_number`` and ``travelling_index``.
        place: Joint name, or ``body``; of waves in several planes ``body, PLANE``.
        unit: Of ``a``, ``b`` and ``difference``; gains, amplitudes and frequencies differ by their
            ratio less one, in ``1``.
        difference: B minus A (of gains, amplitudes and frequencies B/A - 1), its interval holding
            together with all the others of the comparison at 95 %.
        p: Of no difference, this one by itself.
        p_holm: The same for the whole family (Holm).
        size: abs(difference) in margins.
    """

    quantity: str
    place: str
    unit: str
    a: float
    b: float
    difference: Estimate
    p: float
    p_holm: float
    size: float


@dataclass(frozen=True)
class NamedJoint:
    """A joint that answers its command, or moves, differently on the two sides.

    Attributes:
        size: abs of the difference of ln(response/command), gain and lag in margins together;
            without commands amplitude and phase lag.
        p_holm: Of its clearer part, for the whole family.
    """

    name: str
    size: float
    p_holm: float


@dataclass(frozen=True)
class BrokenJoint:
    """A joint that does not follow its command, or stands off it, on one side only.

    Attributes:
        side: ``A`` or ``B``.
        kinds: Kinds of fault that fit; empty for a joint that stands off its command.
        text: What it does, as a clause.
    """

    name: str
    side: str
    kinds: tuple[str, ...]
    text: str


@dataclass(frozen=True)
class Equivalence:
    """Two one-sided tests that all of one quantity are the same within a margin.

    Attributes:
        quantity: As in :class:`Difference`.
        margin: In ``unit``.
        unit: ``1``, ``rad``, ``rad/joint``, ``s``, ``J`` or ``m/s``.
        largest: The largest difference without its sign; of the logarithm for gains,
            amplitudes and frequencies.
        p: Of 'some difference is as large as the margin'.
    """

    quantity: str
    margin: float
    unit: str
    largest: float
    p: float


@dataclass(frozen=True)
class Waveform:
    """Mean cycle of a joint's response by gait phase, without commands by that of its first joint.

    Attributes:
        a_rad: On side A at each phase [rad].
        b_rad: On side B [rad].
        difference_rad: B minus A [rad].
        half_rad: Half widths of its 95 % intervals, each phase by itself [rad].
        rms_rad: Root mean square of the difference [rad].
        largest: The largest difference, with its sign [rad]; its interval does not count that it
            was chosen.
        largest_at_rad: The phase where it is [rad].
    """

    name: str
    a_rad: tuple[float, ...]
    b_rad: tuple[float, ...]
    difference_rad: tuple[float, ...]
    half_rad: tuple[float, ...]
    rms_rad: float
    largest: Estimate
    largest_at_rad: float


@dataclass(frozen=True, repr=False)
class Comparison(PresentedResult):
    """Two sessions, or two groups of them, side by side.

    Example::

        result = undulog.compare("run.mcap", "again.mcap")
        names = [joint.name for joint in result.named]

    Attributes:
        verdict: ``different``, ``same`` (within the margins), ``small`` (different, by less than
            the margins) or ``open``.
        design: ``sessions`` (one a side, errors from each session's own noise), ``groups``
            (independent runs, Welch) or ``pairs`` (run by run).
        partial: What the comparison leaves out or takes in its stride; None for nothing.
        changed: What the sessions themselves say was changed.
        broken: Joints that do not follow their command on one side only: the first differences.
        named: Joints that answer differently, the largest difference first.
        differences: All decisions: those beyond doubt first, by size, then the others by p.
        equivalence: Of gain, lag, energy and motion, each over all joints.
        phase_rad: Gait phases of the waveforms [rad].
        waveforms: Mean cycles, head to tail.
        warnings: One sentence each.
    """

    answer: str
    verdict: str
    design: str
    a: tuple[SessionFacts, ...]
    b: tuple[SessionFacts, ...]
    partial: str | None
    changed: tuple[MetadataChange, ...]
    named: tuple[NamedJoint, ...]
    differences: tuple[Difference, ...]
    equivalence: tuple[Equivalence, ...]
    phase_rad: tuple[float, ...]
    waveforms: tuple[Waveform, ...]
    warnings: tuple[str, ...]
    provenance: Provenance
    broken: tuple[BrokenJoint, ...] = ()

    @property
    def commanded(self) -> bool:
        """Whether the sessions have commands, and so gains and lags."""
        return not any(
            difference.quantity in ("amplitude", "frequency") for difference in self.differences
        )


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
        first = next(module for module in modules if module.name == named[0])
        clear = {kind: e for kind, e in first.relative.items() if leaves_out_zero(e.ci95)}
        shown = (clear or first.relative).items()
        deviations = ", ".join(
            f"{_words(kind)} {formats.percent(relative)}" for kind, relative in shown
        )
        also = f"; then {', '.join(named[1:])}" if len(named) > 1 else ""
        return f"{first.name} deviates: {deviations} ({formats.p_value_text(p)}){also}"
    if fit_p < SIGNIFICANT:
        return (
            f"neither identical modules nor a single one that deviates explain this session "
            f"(fit {formats.p_value_text(fit_p)}): the model is not of this robot, ground or gait"
        )
    bounds: list[str] = []
    for kind in modules[0].relative:
        ends = [abs(end) for module in modules for end in module.relative[kind].ci95 or (math.inf,)]
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
        f"{_words(parameter.name)} {formats.estimate(parameter.fitted)} {parameter.unit} "
        f"(model {parameter.assumed:.4g})"
        for parameter in result.parameters
    )
    return [
        f"Modules, {result.condition}: {result.answer}.",
        f"Shared by all modules: {shared}; fit {formats.p_value_text(result.fit_p)}.",
    ]


def _words(name: str) -> str:
    return name.replace("_", " ")
