"""What several sessions of one experiment say together.

``Experiment.to_dict`` is the object that ``undulog analyse A.mcap B.mcap ... --json`` prints. As in
:mod:`.analysis.results.analysis`, what could not be computed is None (null), and ``warnings`` says
why.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from ..common.estimate import Estimate, PresentedResult, Provenance
from ..parts.heterogeneity.result import Index
from .analysis import Analysis
from .best_linear import BestLinearResponses
from .body_connection import BodyConnection
from .coupling import Coupling
from .oscillators import BodyOscillators

BLIND = (
    "blind to what is alike at both joints of a mirror pair and to the middle joint of an odd "
    "number; for those, swap modules and record again"
)


@dataclass(frozen=True)
class Run:
    """One session's part in the experiment.

    Attributes:
        wave: ``head-to-tail``, ``tail-to-head``, ``standing`` or None.
        role: ``forward`` (wave from head to tail), ``reverse``; among kicks ``base``, ``kick`` or
            ``held-out``; ``sweep``; ``multisine``; ``perturbed``; or None where it has none.
    """

    id: str
    path: str
    wave: str | None
    role: str | None
    why: str | None = None


@dataclass(frozen=True)
class MirrorJoint:
    """d_i: a joint in the forward runs minus its mirror joint in the reverse runs.

    All intervals of a reversal hold together at 95 %.

    Attributes:
        mirror: The joint as far from the tail as this one is from the head.
        log_gain_difference: Of ln gain [1].
        lag_difference_rad: Positive = the joint is later than its mirror joint [rad].
        p: Family-wise, of the pair: of its contrast and its common part, gain and lag together.
    """

    name: str
    mirror: str
    log_gain_difference: Estimate
    lag_difference_rad: Estimate
    p: float


@dataclass(frozen=True)
class OrderedPair:
    """A joint that answers less or later than its mirror joint, whichever way the wave runs.

    Either this joint is weaker or its mirror joint stronger: the contrast is the same.

    Attributes:
        name: The joint that answers less.
        by: ``gain`` or ``lag``: which of them shows it more clearly.
        log_gain_contrast: ln gain of the joint minus that of its mirror joint, mean of both ways.
        lag_contrast_rad: The same of the lag [rad].
        p: Family-wise over all pairs, gain and lag.
        module: The single module that differs, ``name`` or ``mirror``; None where no further
            evidence decides between them.
        evidence: That evidence, one clause; empty without.
    """

    name: str
    mirror: str
    by: str
    log_gain_contrast: Estimate
    lag_contrast_rad: Estimate
    p: float
    module: str | None = None
    evidence: str = ""


class Headings(StrEnum):
    """What the robot's headings in the runs allow."""

    BALANCED = "balanced"
    """Each wave has its mirror image: the reverse, the robot turned by half a turn."""
    UNBALANCED = "unbalanced"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class FloorTilt:
    """Whether a tilted floor can make the differences of a reversal.

    Attributes:
        headings: Of the robot in the runs; balanced ones cancel a tilt by design.
        strata: Sets of runs that are mirror images of each other.
        ratio: Root mean square of what both joints of a pair do otherwise the other way, over that
            of their contrast: above 1 for a tilt, below for one module.
        middle: Largest size of the middle joint's difference over the least size of the largest
            contrast (95 %): below 1 for one module; None for an even number of joints, or where
            no contrast differs from zero.
        gravity_rad: Lean along the body by recorded gravity [rad], downhill towards the head
            positive; empty without.
        excluded: Whether headings or checks exclude a tilt as the cause.
    """

    headings: Headings
    strata: int
    ratio: Estimate
    middle: float | None
    gravity_rad: Estimate
    excluded: bool


@dataclass(frozen=True, repr=False)
class Reversal(PresentedResult):
    """Test of H1, that the modules are identical, by running the wave both ways.

    Attributes:
        forward_runs: Independent runs with the wave from head to tail.
        reverse_runs: The same from tail to head.
        statistic: T, the largest studentised contrast or common part of all pairs, gain and lag.
        p: Of H1; exact, family-wise.
        p_floor: The smallest p that so many runs can give.
        labellings: Ways to deal out the labels.
        labellings_tried: All of them, or a random subset.
        joints: In chain order, head to tail.
        pairs: The largest contrast first; empty where none is shown. Those after the first may be
            what a module does to its neighbours.
        gain_bound: No joint's gain differs from its mirror's by a larger share (95 %).
        lag_bound_rad: No joint's lag differs from its mirror's by more (95 %) [rad].
        equivalence_gain_p: Of 'some pair differs by 2 % or more'.
        equivalence_lag_p: Of 'some pair differs by 1 degree or more'.
        module_variance: V_module of ln(response/command), gain and lag together.
        module_share: V_module / (V_module + V_boundary).
        tilt: Whether a tilted floor can make the differences.
        middle: The middle joint of an odd number, which is its own mirror joint.
        blind: What the test can't see.
    """

    forward_runs: int
    reverse_runs: int
    statistic: float
    p: float
    p_floor: float
    labellings: int
    labellings_tried: int
    joints: tuple[MirrorJoint, ...]
    pairs: tuple[OrderedPair, ...]
    gain_bound: float
    lag_bound_rad: float
    equivalence_gain_p: float
    equivalence_lag_p: float
    module_variance: Estimate
    boundary_variance: Estimate
    noise_variance: float
    module_share: Estimate
    boundary_share: Estimate
    tilt: FloorTilt
    middle: str | None = None
    blind: str = BLIND


@dataclass(frozen=True)
class PooledJoint:
    """One joint's response over several runs.

    Attributes:
        gain: Amplitude of the response over that of the command.
        lag_rad: Positive = late [rad].
    """

    name: str
    gain: Estimate
    lag_rad: Estimate


@dataclass(frozen=True)
class PooledRuns:
    """Several runs of one direction as one; the scatter from run to run is in the intervals.

    Attributes:
        joints: In chain order, head to tail.
    """

    runs: int
    joints: tuple[PooledJoint, ...]


@dataclass(frozen=True, kw_only=True, repr=False)
class Experiment(PresentedResult):
    """All numbers of several sessions.

    Example::

        result = undulog.analyse("run.mcap", "again.mcap")
        print(result.answer)

    Attributes:
        answer: One sentence: boundary or module? Or, of kicks, who follows whom?
        sessions: Each session by itself.
        runs: Each session's part in the experiment, in the same order.
        heterogeneity: Index name to index, from all runs together.
        reversal: None where it can't be tested; a warning says why.
        coupling: Identifiable or not; from kicks around one gait a
            :class:`.analysis.results.coupling.LocalCoupling`, from a sweep without contact a
            :class:`.analysis.results.coupling.LinearCoupling`.
        warnings: One sentence each.
        oscillators: From kicks around one gait: how oscillators that feel their servos would
            synchronise through the body; None without such kicks.
        pooled: The response over the runs, where all of them are of one direction.
        body_connection: From gaits around one gait: how shape moves the body; None without the
            head's pose.
        best_linear: Frequency responses with their nonlinear distortion, where the sessions are
            runs of one multisine experiment over a band.
    """

    answer: str
    sessions: tuple[Analysis, ...]
    runs: tuple[Run, ...]
    heterogeneity: dict[str, Index]
    reversal: Reversal | None
    pooled: PooledRuns | None = None
    coupling: Coupling
    oscillators: BodyOscillators | None = None
    best_linear: BestLinearResponses | None = None
    body_connection: BodyConnection | None = None
    warnings: tuple[str, ...]
    provenance: Provenance

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain JSON values.

        An estimate becomes an object of ``value`` and ``ci95``; each session is the object that
        it gives by itself.
        """
        record = dataclasses.asdict(dataclasses.replace(self, sessions=()))
        return record | {"sessions": [session.to_dict() for session in self.sessions]}
