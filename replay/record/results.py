"""Results as a layer over a session: computed now, or those that were saved.

``undulog analyse``, with one session or several, and ``undulog compare`` save what they found; a
session that they speak of can be seen with it. Modules that a test names carry a mark on the body,
at their bars and below the maps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from undulog.analysis.present.notebook.files import load
from undulog.analysis.results.analysis import Analysis
from undulog.analysis.results.comparison import Comparison
from undulog.analysis.results.experiment import Experiment
from undulog.analysis.results.formats import told_p
from undulog.analysis.results.null_model import ModelledAnalysis
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.cycles import cycle_maps
from undulog.analysis.signals.stretch import Options
from undulog.capture import SessionView
from undulog.capture.common.errors import DataError, MissingChannelError, UndulogError

from ..content.layer import Layer, Named


def computed(session: SessionView, options: Options | None = None) -> Layer:
    """Analyse a session now; one without a gait can be seen too.

    Args:
        session: The session, open.
        options: Where its joints are; None for the topics of the log contract.

    Returns:
        The layer, with a note where there are no numbers.
    """
    try:
        measured = measure_session(session, options)
    except MissingChannelError as error:
        # What is there is listed, and one of it may be what was looked for.
        name = "name them with --command-topic and --response-topic"
        return Layer(None, notes=(f"not analysed: {error}; {name}",))
    except UndulogError as error:
        return Layer(None, notes=(f"not analysed: {error}",))
    analysis = measured.analysis
    return Layer(analysis, cycle_maps(measured) if analysis.over_time is None else None)


def saved(session: SessionView, paths: Sequence[Path], options: Options | None = None) -> Layer:
    """Read what was found of a session before.

    Args:
        session: The session, open.
        paths: Results, JSON: of the session, of an experiment or a comparison that it is part of.
        options: As for :func:`computed`, where no result holds numbers.

    Returns:
        The layer; its numbers are computed now where no result holds them.

    Raises:
        InputFileError: If a file can't be read.
        DataError: If one holds no result, one that names no session, one of other sessions, or a
            second one with numbers of this session.
    """
    known = found_before(session, paths)
    return known if known.analysis is not None else known.with_numbers(computed(session, options))


def found_before(session: SessionView, paths: Sequence[Path]) -> Layer:
    """Read what was found of a session before, and compute nothing.

    Args:
        session: The session, open.
        paths: As for :func:`saved`.

    Returns:
        The layer; without numbers where no result holds them.

    Raises:
        InputFileError: As :func:`saved`.
        DataError: As :func:`saved`.
    """
    analysis: Analysis | None = None
    named: dict[str, list[str]] = {}
    notes: list[str] = []
    for path in paths:
        result = load(path)
        if not isinstance(result, (Analysis, Experiment, Comparison)):
            kind = type(result).__name__
            raise DataError(
                f"{path}: a {kind} names no session; give the result that it is part of"
            )
        own = _own(result, session, path)
        if own is not None and analysis is not None:
            raise DataError(f"{path}: the second result with numbers of this session; give one")
        analysis = own or analysis
        if own is not None:
            notes.append(f"gain, lag and energy are those of {path.name}")
        for one in (
            *_named(result),
            *(_named(own) if own is not None and own is not result else ()),
        ):
            named.setdefault(one.joint, []).append(f"{one.why} ({path.name})")
    found = tuple(Named(joint, "; ".join(dict.fromkeys(why))) for joint, why in named.items())
    return Layer(analysis, named=found, notes=tuple(notes))


def _own(
    result: Analysis | Experiment | Comparison, session: SessionView, path: Path
) -> Analysis | None:
    """The session's own numbers in a result, or None where it only compares."""
    if isinstance(result, Analysis):
        known = [result.session.id]
    elif isinstance(result, Experiment):
        known = [one.session.id for one in result.sessions]
    else:
        known = [one.id for one in (*result.a, *result.b)]
    if session.session_id not in known:
        raise DataError(
            f"{path}: a result of {_listed(known)}; the session is {session.session_id}, so give "
            "the result of that one"
        )
    if isinstance(result, Analysis):
        return result
    if isinstance(result, Experiment):
        return result.sessions[known.index(session.session_id)]
    return None


def _listed(ids: Sequence[str]) -> str:
    few = ", ".join(ids[:3])
    return f"session{'s' * (len(ids) > 1)} {few}{' and others' * (len(ids) > 3)}"


def _named(result: Analysis | Experiment | Comparison) -> Iterator[Named]:
    if isinstance(result, Experiment) and result.reversal is not None:
        for pair in result.reversal.pairs:
            how = "less gain" if pair.by == "gain" else "more lag"
            floor = "" if result.reversal.tilt.excluded else ", or the floor is tilted"
            why = f"{how} than its mirror joint {pair.mirror}, {told_p(pair.p)}{floor}"
            yield Named(pair.name, why)
    elif isinstance(result, Comparison):
        for joint in result.named:
            if joint.size >= 1.0:  # in margins: what differs by less is there, but small
                yield Named(joint.name, f"answers differently in A and B, {told_p(joint.p_holm)}")
    elif isinstance(result, ModelledAnalysis):
        test = result.null_model
        for module in test.modules:
            if module.name in test.named:
                yield Named(module.name, f"deviates from the others' model, {told_p(module.p)}")
