"""The verbs ``plan ...``: from a recorded gait to the sessions of commands of an experiment."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from undulog.capture.common.console import emit_json, say
from undulog.capture.common.errors import UsageError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from ..plan.designs import PlannedRun
    from ..plan.gait_base import BaseGait


LEAST, MOST = 0.01, 0.12
"""Kicks that the analysis takes for kicks; of others it says that they are too small or large."""


def phase_kicks(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    runs: int = 1,
    base_runs: int = 6,
    kick: float = 0.05,
    settle: float = 10.0,
    measure: float = 10.0,
    json: bool = False,
) -> None:
    """Write the commands of kicks around a recorded gait, which tell its coupling.

    Six runs of the gait itself, which show how much runs differ, four of each driven joint (phase
    +0.05 and -0.05 rad, amplitude +5 and -5 %), three held-out random patterns. Drive each with
    `undulog drive`, then give all recordings to `undulog analyse`.

    Example: `undulog plan phase-kicks --like run.mcap -o kicks`

    Args:
        like: A session of the gait.
        output: Folder for the sessions.
        runs: How often each of them is run; those of the gait as it is are shared out.
        base_runs: Runs of the gait as it is, in all.
        kick: Size of the kicks, of phase [rad] and of log amplitude.
        settle: Time before what is measured [s].
        measure: Length of what is measured [s].
        json: Print one JSON object.
    """
    if base_runs < 1 or not LEAST <= kick <= MOST:
        raise UsageError(f"--base-runs is at least 1, --kick {LEAST:g} to {MOST:g}")

    def design(base: BaseGait) -> tuple[PlannedRun, ...]:
        from ..plan.designs import phase_kicks as kicks

        if len(base.driven) < 3:
            raise UsageError(f"{like}: it drives {len(base.driven)} joints; kicks need at least 3")
        return kicks(
            tuple(base.names[k] for k in base.driven),
            base.amplitude,
            runs,
            kick=kick,
            base_runs=base_runs,
        )

    _plan("phase-kicks", like, output, design, (runs, settle, measure), as_json=json)


def reversal(
    *,
    like: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    runs: int = 6,
    settle: float = 10.0,
    measure: float = 10.0,
    json: bool = False,
) -> None:
    """Write the commands of a recorded gait and of its reverse, which tell boundary from module.

    The robot is turned by 180 degrees in half of the runs of each direction, so that a tilted floor
    cancels. The heading is in each file's name and metadata; the twin starts with it, a robot has
    to be put down so.

    Example: `undulog plan reversal --like run.mcap -o reversal`

    Args:
        like: A session of the gait.
        output: Folder for the sessions.
        runs: Runs each way, an even number so that half of them are turned.
        settle: Time before what is measured [s].
        measure: Length of what is measured [s].
        json: Print one JSON object.
    """

    def design(base: BaseGait) -> tuple[PlannedRun, ...]:
        from ..plan.designs import reversal as both_ways

        return both_ways(base.amplitude, runs)

    _plan("reversal", like, output, design, (runs, settle, measure), as_json=json)
    if not json:
        say(
            "Before each file whose name ends in -180, put the robot down turned by 180 degrees; "
            "before the others, as in the first"
        )


def _plan(
    plan: str,
    like: Path,
    folder: Path,
    design: Callable[[BaseGait], tuple[PlannedRun, ...]],
    numbers: tuple[int, float, float],
    *,
    as_json: bool,
) -> None:
    runs, settle_s, measure_s = numbers
    if runs < 1 or settle_s < 0 or measure_s <= 0:
        raise UsageError("--runs is at least 1, --settle at least 0, --measure more than 0")
    from undulog.capture import Session

    from ..plan.gait_base import base_gait
    from ..plan.write import write_plan

    with Session.open(like) as session:
        base = base_gait(session)
        files = write_plan(
            plan, base, design(base), session, folder, settle_s=settle_s, measure_s=measure_s
        )
    announce(plan, folder, files, (settle_s, measure_s), as_json=as_json)


def announce(
    plan: str, folder: Path, files: Sequence[Path], times_s: tuple[float, float], *, as_json: bool
) -> None:
    """Say what was written, and what to do with it.

    Args:
        plan: Name of the design.
        folder: Where the files are.
        files: One a run.
        times_s: Of a run's settling, and of what is measured after it [s].
        as_json: Print one JSON object.
    """
    settle_s, measure_s = times_s
    if as_json:
        emit_json({"plan": plan, "files": [str(file) for file in files], "settle_s": settle_s})
        return
    say(
        f"{folder}: {plan}, {len(files)} runs of {settle_s + measure_s:g} s, "
        f"{len(files) * (settle_s + measure_s) / 60:.1f} min in all"
    )
    say(
        "Drive each, in this order, with undulog drive FILE --on ...; then undulog analyse "
        f"--start {settle_s:g} of all recordings"
    )
