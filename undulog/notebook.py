"""Functions for notebooks and scripts: sessions by path, results as objects.

::

    import undulog

    result = undulog.analyse("run.mcap")
    undulog.compare("before.mcap", "after.mcap").plot()

They open what they are given by path and close it again; an open session stays open.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Mapping
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload

if TYPE_CHECKING:
    from undulog.analysis import Analysis, Choices, Comparison, Experiment, Options
    from undulog.capture import SessionView
    from undulog.sim import Scenario
    from undulog.sim.twin.recording import TwinRecording

    SessionLike: TypeAlias = SessionView | Path | str
    """An open session or a view of one, or the path or URL of a session."""


@overload
def analyse(session: SessionLike, /, *, options: Options | None = None) -> Analysis: ...
@overload
def analyse(
    session: SessionLike, second: SessionLike, /, *more: SessionLike, options: Options | None = None
) -> Experiment: ...
def analyse(session: SessionLike, /, *more: SessionLike, options: Options | None = None) -> Any:
    """Analyse a session, or several as one experiment, as ``undulog analyse`` does.

    Args:
        session: An open session, or its path or URL.
        more: Further sessions of the same experiment.
        options: What is analysed; None for the defaults of the command.

    Returns:
        All numbers of one session, or of the experiment where there are several.

    Example::

        result = undulog.analyse("run.mcap")
        gains = [joint.gain.value for joint in result.joints]

    Raises:
        InputFileError: If a file can't be read.
        DataError: If a session has no commands or responses, or no samples of them.
        UsageError: If the options leave nothing of a session.
    """
    from undulog.analysis import analyse_experiment, analyse_session

    with _one_thread_of_linear_algebra():
        if more:
            return analyse_experiment(_each([session, *more]), options)
        with _opened(session) as view:
            return analyse_session(view, options)


def compare(
    a: SessionLike | Iterable[SessionLike],
    b: SessionLike | Iterable[SessionLike],
    *,
    choices: Choices | None = None,
) -> Comparison:
    """Compare two sessions, or two groups of runs: B minus A, as ``undulog compare`` does.

    Args:
        a: A session, open or by its path or URL; or several, runs of one condition.
        b: Those of the other condition.
        choices: Options of the comparison; None for the defaults of the command.

    Returns:
        What differs, with intervals, the largest difference first.

    Example::

        print(undulog.compare("run.mcap", "again.mcap").answer)

    Raises:
        InputFileError: If a file can't be read.
        DataError: If sessions have no gait or periodic motion, no joint in common or another gait,
            or only some have commands.
        UsageError: If a side has no session, a group has one run, or runs don't pair up.
    """
    from undulog.analysis import compare_sessions
    from undulog.capture import SessionView

    def group(side: SessionLike | Iterable[SessionLike]) -> Iterable[SessionView]:
        return _each([side] if isinstance(side, SessionView | Path | str) else side)

    with _one_thread_of_linear_algebra():
        return compare_sessions(group(a), group(b), choices)


def record(
    scenario: Scenario | Path | str,
    path: Path | str,
    *,
    changes: Mapping[str, Any] | None = None,
    duration_s: float | None = None,
    seed: int | None = None,
    force: bool = False,
) -> TwinRecording:
    """Run the twin into a session file, as ``undulog sim run`` does.

    Args:
        scenario: A scenario, the name of a shipped one, or a TOML file.
        path: Of the session, an MCAP file.
        changes: Keys of the scenario file, with dots, to the values that they are to have instead;
            not for a scenario that is read already.
        duration_s: Length of the run instead of the scenario's [s].
        seed: Of the noise, instead of the scenario's.
        force: Replace the file if it is there.

    Returns:
        Where the session is, its length, and what only the twin knows: energies and contacts.

    Example::

        undulog.record("flat", "run.mcap", duration_s=6.0, seed=1)
        undulog.record("flat", "again.mcap", duration_s=6.0, seed=2)

    Raises:
        UsageError: If no scenario has that name, or changes are given for one that is read.
        ScenarioError: If it has faults.
        SimulationError: If the twin's state becomes impossible.
        OutputExistsError: If the file is there and ``force`` is not given.
        LogWriteError: If it can't be written.
    """
    from undulog.capture.common.errors import UsageError
    from undulog.sim import load_scenario
    from undulog.sim import record as record_scenario

    if isinstance(scenario, Path | str):
        scenario = load_scenario(scenario, changes)
    elif changes:
        raise UsageError("changes are for a scenario's name or file, not for one that is read")
    chosen = scenario.changed(duration_s=duration_s, seed=seed)
    with _one_thread_of_linear_algebra():
        return record_scenario(chosen, path, force=force)


def _one_thread_of_linear_algebra() -> AbstractContextManager[object]:
    """Keep NumPy and SciPy from threads of their own, as the command does by its environment.

    The matrices are small: more threads wait for each other, on a busy machine for most of the
    time.
    """
    from threadpoolctl import threadpool_limits

    import_module("scipy.linalg")  # what is loaded later isn't limited
    return threadpool_limits(1, "blas")


@contextmanager
def _opened(session: SessionLike) -> Generator[SessionView]:
    from undulog.capture import Session

    if not isinstance(session, Path | str):
        yield session
        return
    with Session.open(session) as opened:
        yield opened


def _each(sessions: Iterable[SessionLike]) -> Generator[SessionView]:
    """Open sessions one by one; each is closed when the next is asked for."""
    for session in sessions:
        with _opened(session) as view:
            yield view
