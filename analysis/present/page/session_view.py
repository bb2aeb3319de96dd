"""What the page shows of one session."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from undulog.capture import Session
from undulog.capture.common.palette import joint_hex

from ...results import formats
from ...results.analysis import Analysis, JointResult
from ...results.answer import Answer
from ...session.cycles import CycleMaps
from .artefacts import ArtefactRow, artefact_rows, flagged_joints
from .drawn import Drawing
from .driven import is_driven
from .entries import Entries, entries_of
from .maps import cycle_drawings
from .matrix import matrix_picture
from .motion import body_motion
from .oscillators import ChainView, chain_views
from .segments import segments
from .signals import command_response, read_traces
from .tables import Column, Fact, energy_columns, key_figures, response_columns
from .trials import Trial, session_trials
from .typeset import cut


@dataclass(frozen=True)
class SessionView:
    """All that the template shows of one session.

    Attributes:
        analysis: The numbers.
        answer: The answer in one sentence.
        notices: The first few warnings, cut to a line or two.
        facts: Key figures.
        colors: One colour a joint.
        response: Columns of the table of responses.
        energy: Columns of the table of energies.
        trials: Tests with their verdicts.
        segments: Gain, lag and energy.
        signals: Command against response, or None.
        maps: Joints against cycles, or none.
        body: Head, middle, tail, or None.
        artefacts: What is wrong with samples, and when.
        flagged: Flag in the analysed cycles, and the joints that have it.
        entries: The coupling matrix, or none.
        matrix: Its picture, or None.
        chains: Couplings of the oscillators that drove it, one a plane.
    """

    analysis: Analysis
    answer: Answer
    notices: tuple[str, ...]
    facts: tuple[Fact, ...]
    colors: tuple[str, ...]
    response: tuple[Column, ...]
    energy: tuple[Column, ...]
    trials: tuple[Trial, ...]
    segments: Drawing | None
    signals: Drawing | None
    maps: tuple[Drawing, ...]
    body: Drawing | None
    artefacts: tuple[ArtefactRow, ...]
    flagged: tuple[tuple[str, str], ...]
    entries: tuple[Entries, ...]
    matrix: Drawing | None
    chains: tuple[ChainView, ...]


def session_view(
    analysis: Analysis, session: Session | None, cycles: CycleMaps | None
) -> SessionView:
    """Prepare what the template shows of one session.

    Args:
        analysis: The numbers.
        session: Open, or None.
        cycles: Its cycles, or None.

    Returns:
        The view.
    """
    joints = analysis.joints
    traces = read_traces(session, analysis) if session is not None else ()
    body = analysis.body
    driven = tuple(joint.name for joint in joints if is_driven(joint))
    told = analysis.answer
    others = [w for w in map(formats.sentence, analysis.warnings) if w not in told.detail]
    entries = entries_of(analysis.coupling, driven)
    return SessionView(
        analysis=analysis,
        answer=told,
        notices=tuple(cut(warning) for warning in others[:3]),
        facts=tuple(key_figures(analysis)),
        colors=joint_hex(len(joints)) if joints else (),
        response=response_columns(joints),
        energy=energy_columns(joints),
        trials=session_trials(analysis.heterogeneity),
        segments=segments(joints, "segments-figure") if _anything(joints) else None,
        signals=command_response(traces, len(joints), "signals-figure") if traces else None,
        maps=() if cycles is None else cycle_drawings(cycles, "map"),
        artefacts=artefact_rows(analysis),
        flagged=flagged_joints(joints),
        body=body_motion(body, "body-figure") if body is not None and body.observed else None,
        entries=entries,
        matrix=matrix_picture(entries[0], "coupling-figure") if entries else None,
        chains=chain_views(analysis.oscillators),
    )


def _anything(joints: Sequence[JointResult]) -> bool:
    """Whether any joint has something that the figure of segments shows."""
    return any(
        v is not None for j in joints for v in (j.gain.value, j.energy_net_j, j.energy_abs_j)
    )
