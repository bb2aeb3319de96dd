"""Results as a layer over a session: computed now, or those that were saved.

``undulog analyse``, with one session or several, and ``undulog compare`` save what they found; a
session that they speak of can be seen with it. Modules that a test names carry a mark on the body,
at their bars and below the maps.

While a viewer waits, the analysis runs in a process of its own, which can be ended at any time: it
takes seconds and memory that the picture needs first, and once it is done all of that is free.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from undulog.analysis.common.formats import p_value_text
from undulog.analysis.results.analysis import Analysis
from undulog.analysis.results.comparison import Comparison, ModelledAnalysis
from undulog.analysis.results.experiment import Experiment
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.session.cycle_maps import cycle_maps
from undulog.analysis.session.parts import BEYOND_THE_GAIT
from undulog.analysis.signals.stretch import Options
from undulog.capture import Session, SessionView
from undulog.capture.common.errors import DataError, UndulogError
from undulog.capture.common.waits import LIMIT_S, Standstill, end_process, processor_time

from .samples.content import Layer, Named

_NICENESS = 10


class Analysing(AbstractContextManager["Analysing"]):
    """An analysis that is started when there is time for it, and ended on leaving."""

    def __init__(self, path: Path, topics: tuple[str, str], robot: str | None = None) -> None:
        """Prepare it.

        Args:
            topics: JointState topics of its commands and responses.
            robot: Description for a log without one.
        """
        self._arguments = [str(path), *topics, *([] if robot is None else [robot])]
        self._process: subprocess.Popen[bytes] | None = None
        self._answer = tempfile.TemporaryFile()  # noqa: SIM115  closed with the process
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115
        self._still = Standstill(LIMIT_S)

    def __exit__(self, *_: object) -> None:
        """End it."""
        try:
            if self._process is not None:  # it has nothing to put in order
                end_process(self._process, "the analysis of the session")
        finally:
            self._answer.close()
            self._stderr.close()

    def start(self) -> None:
        """Start it, unless it has been."""
        if self._process is None:
            self._process = subprocess.Popen(  # noqa: S603  our own arguments
                # -P: a file of the user's in this folder is not to be taken for one of ours.
                [sys.executable, "-P", "-m", __name__, *self._arguments],
                stdin=subprocess.DEVNULL,
                stdout=self._answer,
                stderr=self._stderr,
                process_group=0,  # a Ctrl-C ends it through us
            )

    @property
    def layer(self) -> Layer | None:
        """Its result; None while it isn't done, and a note if it failed."""
        if self._process is None:
            return None
        if self._process.poll() is None:
            if not self._still.reached(processor_time([self._process.pid])):
                return None
            end_process(self._process, "the analysis of the session")
            why = f"the analysis computed nothing for {LIMIT_S:g} s and was ended"
            return Layer(None, notes=(f"not analysed: {why}; start the command again",))
        code = self._process.returncode
        if code:
            self._stderr.seek(0)
            lines = self._stderr.read().decode(errors="replace").split("\n")
            last = next((line for line in reversed(lines) if line.strip()), "")
            why = f": {last.strip()}" if last else ""
            return Layer(None, notes=(f"not analysed: the analysis ended with {code}{why}",))
        self._answer.seek(0)
        layer: Layer = pickle.load(self._answer)  # noqa: S301  of our own process
        return layer


def main(arguments: Sequence[str]) -> None:
    """Analyse a session and write the result to standard output.

    Args:
        arguments: The session's path, the topics of commands and responses, and a robot if given.
    """
    os.nice(_NICENESS)
    path, command, response, *robot = arguments
    options = Options(command_topic=command, response_topic=response)
    folder = Path(tempfile.gettempdir())  # its columns lie there in files without names
    given = robot[0] if robot else None
    with Session.open(path, column_folder=folder, robot=given) as session:
        layer = computed(session, options)
    pickle.dump(layer, sys.stdout.buffer)


def computed(session: SessionView, options: Options | None = None) -> Layer:
    """Analyse a session; one without a gait gets a note instead.

    Args:
        options: Where its joints are; None for the topics of the log contract.

    Returns:
        The layer, with a note where there are no numbers.
    """
    try:
        measured = measure_session(session, options, without=BEYOND_THE_GAIT)
    except UndulogError as error:
        return Layer(None, notes=(f"not analysed: {error}",))
    analysis = measured.analysis
    return Layer(analysis, cycle_maps(measured) if analysis.over_time is None else None)


def saved(session: SessionView, paths: Sequence[Path], options: Options | None = None) -> Layer:
    """Read saved results of a session, and analyse it if they have no numbers.

    Args:
        paths: Results, JSON: of the session, of an experiment or a comparison that it is part of.
        options: As for :func:`computed`, where no result holds numbers.

    Returns:
        The layer; its numbers are computed now where no result holds them.

    Raises:
        InputFileError: If a file can't be read.
        DataError: If one holds no result, one that names no session, one of other sessions, or a
            second one with numbers of this session.
    """
    results = read_results(session, paths)
    return (
        results
        if results.analysis is not None
        else results.with_numbers(computed(session, options))
    )


def read_results(session: SessionView, paths: Sequence[Path]) -> Layer:
    """Read saved results of a session.

    Args:
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
        # Here, not above: it imports pandas, which an analysis without results doesn't need.
        from undulog.analysis.present.result_files import load

        result = load(path)
        if not isinstance(result, (Analysis, Experiment, Comparison)):
            kind = type(result).__name__
            raise DataError(
                f"{path}: a {kind} names no session; give the result that it is part of"
            )
        numbers = _own(result, session, path)
        modules = list(_named(result))
        if numbers is not None:
            if analysis is not None:
                raise DataError(f"{path}: the second result with numbers of this session; give one")
            analysis = numbers
            notes.append(f"gain, lag and energy are those of {path.name}")
            modules += _named(numbers) if numbers is not result else ()
        for module in modules:
            named.setdefault(module.joint, []).append(f"{module.why} ({path.name})")
    merged = tuple(Named(joint, "; ".join(dict.fromkeys(why))) for joint, why in named.items())
    return Layer(analysis, named=merged, notes=tuple(notes))


def _own(
    result: Analysis | Experiment | Comparison, session: SessionView, path: Path
) -> Analysis | None:
    """The session's own numbers in a result, or None where it only compares."""
    numbers: dict[str, Analysis | None]
    if isinstance(result, Comparison):
        numbers = dict.fromkeys(session.id for session in (*result.a, *result.b))
    else:
        several = result.sessions if isinstance(result, Experiment) else [result]
        numbers = {analysis.session.id: analysis for analysis in several}
    if session.session_id not in numbers:
        ids = list(numbers)
        few = f"session{'s' * (len(ids) > 1)} {', '.join(ids[:3])}{' and others' * (len(ids) > 3)}"
        raise DataError(
            f"{path}: a result of {few}; the session is {session.session_id}, so give the result "
            "of that one"
        )
    return numbers[session.session_id]


def _named(result: Analysis | Experiment | Comparison) -> Iterator[Named]:
    if isinstance(result, Experiment) and result.reversal is not None:
        for pair in result.reversal.pairs:
            how = "less gain" if pair.by == "gain" else "more lag"
            floor = "" if result.reversal.tilt.excluded else ", or the floor is tilted"
            why = f"{how} than its mirror joint {pair.mirror}, {p_value_text(pair.p)}{floor}"
            yield Named(pair.name, why)
    elif isinstance(result, Comparison):
        for joint in result.named:
            if joint.size >= 1.0:  # in margins: what differs by less is there, but small
                why = f"answers differently in A and B, {p_value_text(joint.p_holm)}"
                yield Named(joint.name, why)
    elif isinstance(result, ModelledAnalysis):
        test = result.null_model
        for module in test.modules:
            if module.name in test.named:
                why = f"deviates from the others' model, {p_value_text(module.p)}"
                yield Named(module.name, why)


if __name__ == "__main__":
    main(sys.argv[1:])
