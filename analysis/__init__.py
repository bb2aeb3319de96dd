"""Numbers from logs: response, energy, spread over the segments, each with its interval.

::

    from undulog.analysis import analyse_session
    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        result = analyse_session(session)
    print(result.joints[0].lag_rad, result.warnings)

Names are imported when first used, so that ``import analysis`` costs nothing.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING

from undulog.capture.lazy import attach

from .notebook.shown import Presentation, present_with

if TYPE_CHECKING:
    from .analyse import analyse_session
    from .compare.compare import Choices, compare_sessions
    from .compare.decisions import Margins
    from .compare.result import Comparison
    from .experiment.analyse import analyse_experiment
    from .notebook.files import load
    from .notebook.picture import Picture
    from .results.analysis import (
        Analysis,
        Estimate,
        Index,
        JointResult,
    )
    from .results.coupling import LocalCoupling
    from .results.experiment import Experiment, Reversal
    from .results.sweep import LinearCoupling
    from .stretch import Options
    from .text.table import render


def _presentation() -> Presentation:
    from .notebook.presentation import Presenter

    return Presenter()


present_with(_presentation)

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "Analysis": "results.analysis",
        "Choices": "compare.compare",
        "Comparison": "compare.result",
        "Estimate": "results.analysis",
        "Experiment": "results.experiment",
        "Index": "results.analysis",
        "JointResult": "results.analysis",
        "LinearCoupling": "results.sweep",
        "LocalCoupling": "results.coupling",
        "Margins": "compare.decisions",
        "Options": "stretch",
        "Picture": "notebook.picture",
        "Reversal": "results.experiment",
        "analyse_experiment": "experiment.analyse",
        "analyse_session": "analyse",
        "compare_sessions": "compare.compare",
        "load": "notebook.files",
        "render": "text.table",
    },
)
