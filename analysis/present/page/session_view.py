"""Prepare one session for the page."""

from __future__ import annotations

from typing import Any

import numpy as np

from undulog.capture import SessionView
from undulog.capture.common.arrays import FloatArray
from undulog.capture.common.palette import joint_hex

from ...results import formats
from ...results.analysis import Analysis
from ...results.answer import Verdict
from ...results.oscillators import ChainCoupling
from ...session.cycles import CycleMaps
from ..text import chain_detail
from .artefacts import artefact_rows, command_response, flagged_joints, read_traces
from .bode import bode
from .maps import cycle_drawings
from .matrix import Entries, entries_of, matrix_picture
from .segments import body_motion, segments
from .tables import is_driven, joint_mark, key_figures
from .trials import session_trials


def session_view(
    analysis: Analysis, session: SessionView | None, cycles: CycleMaps | None, at: str = ""
) -> dict[str, Any]:
    """Return what the template shows of one session, by name.

    Args:
        session: To draw its samples, or None.
        cycles: To draw their maps, or None.
        at: For identifiers, where the page has several sessions.
    """
    joints = analysis.joints
    colors = joint_hex(len(joints)) if joints else ()
    traces = read_traces(session, analysis) if session is not None else ()
    body = analysis.body
    answer = analysis.answer
    entries = entries_of(analysis.coupling, tuple(j.name for j in joints if is_driven(j)))
    drawn = [(j.gain.value, j.energy_net_j, j.energy_abs_j) for j in joints]
    numbers = any(value is not None for values in drawn for value in values)
    return {
        "analysis": analysis,
        "answer": answer,
        "question": _question(analysis),
        "warnings": [w for w in analysis.warnings if formats.sentence(w) not in answer.detail],
        "facts": key_figures(analysis),
        "marks": [
            joint_mark(color, joint.plane, driven=is_driven(joint))
            for color, joint in zip(colors, joints, strict=True)
        ],
        "trials": session_trials(analysis.heterogeneity),
        "segments": segments(joints, f"{at}segments-figure") if numbers else None,
        "bode": bode(analysis.frequency_response, f"{at}bode-figure"),
        "signals": command_response(traces, len(joints), f"{at}signals-figure") if traces else None,
        "maps": () if cycles is None else cycle_drawings(cycles, f"{at}map"),
        "artefacts": artefact_rows(analysis),
        "flagged": flagged_joints(joints),
        "body": body_motion(body, f"{at}body-figure")
        if body is not None and body.observed
        else None,
        "entries": entries,
        "matrix": matrix_picture(entries[0], f"{at}coupling-figure") if entries else None,
        "chains": [
            chain_view(chain, f"{at}oscillators-{k}-figure")
            for k, chain in enumerate(analysis.oscillators, start=1)
        ],
    }


def _question(analysis: Analysis) -> str:
    """Return the question that the answer of a session answers."""
    if analysis.free_motion is not None and analysis.free_motion.joints:
        return "How does the body move without commands?"
    if analysis.answer.verdict is Verdict.SINGLE:
        return "How does the joint respond to its command?"
    return "Do all joints respond to their commands alike, and if not, which differ, and how?"


def chain_view(chain: ChainCoupling, prefix: str) -> dict[str, Any]:
    """Return what the template shows of one chain of oscillators, by name.

    Args:
        prefix: For identifiers, unique in the page.
    """
    lines = list(chain_detail(chain))
    lags = [formats.degrees(link.lag_rad) for link in chain.links]
    rates = chain.oscillators
    return {
        "chain": chain,
        "sentence": lines[0].partition(": ")[2] if chain.identifiable else None,
        "method": lines[-1].removeprefix("Method: ") if chain.identifiable else "",
        "matrix": matrix_picture(_couplings(chain), prefix) if chain.links else None,
        "decimals": (  # of K, of the rates and of the feedback
            formats.decimals_for((link.K for link in chain.links), most=3),
            formats.decimals_for((one.omega for one in rates), most=4),
            formats.decimals_for((one.feedback for one in rates), most=3),
        ),
        "lags": lags,
        "lag_decimals": formats.decimals_for(lags, most=2),
        "fed": any(one.feedback.value is not None for one in rates),
    }


def _couplings(chain: ChainCoupling) -> Entries:
    """Return K as a matrix with NaN for couplings that were not estimated."""
    names = tuple(one.name for one in chain.oscillators)
    place = {name: k for k, name in enumerate(names)}
    value: FloatArray = np.full((len(names), len(names)), np.nan)
    half: FloatArray = np.zeros_like(value)
    for link in chain.links:
        at = place[link.target], place[link.source]
        value[at] = link.K.value or 0.0
        if link.K.ci95 is not None:
            half[at] = (link.K.ci95[1] - link.K.ci95[0]) / 2
    meaning = f"coupling of oscillators, {chain.plane} [1/s]; looked for up to {chain.reach} apart"
    words = ("the oscillator that is turned", "the oscillator that turns it", "is turned by")
    return Entries("K", meaning, names, names, value, half, *words)
