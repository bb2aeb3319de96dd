"""Numbers from logs: response, energy, spread over the segments, each with its interval.

::

    from undulog.analysis import analyse_session
    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        result = analyse_session(session)
    print(result.joints[0].lag_rad, result.warnings)

Names are imported when first used, so that ``import undulog.analysis`` costs nothing.
"""

# pyright: reportUnusedImport=false

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from undulog.capture.common.extras import attach

from .common.estimate import present_with

if TYPE_CHECKING:
    from .catalog.catalog import Catalog as Catalog
    from .catalog.fleet import Fleet as Fleet
    from .catalog.fleet import analyse_fleet as analyse_fleet
    from .common.estimate import Estimate as Estimate
    from .compare.compare import Choices as Choices
    from .compare.compare import compare_sessions as compare_sessions
    from .compare.decisions import Margins as Margins
    from .experiment.analyse import analyse_experiment as analyse_experiment
    from .parts.heterogeneity.result import Index as Index
    from .parts.joints.result import JointResult as JointResult
    from .present.result_files import Picture as Picture
    from .present.result_files import load as load
    from .present.text import render as render
    from .results.analysis import Analysis as Analysis
    from .results.comparison import Comparison as Comparison
    from .results.coupling import LinearCoupling as LinearCoupling
    from .results.coupling import LocalCoupling as LocalCoupling
    from .results.experiment import Experiment as Experiment
    from .results.experiment import Reversal as Reversal
    from .session.analyse import analyse_session as analyse_session
    from .signals.stretch import Options as Options


def _presentation() -> Any:
    from .present import result_files

    return result_files


present_with(_presentation)

__getattr__, __all__ = attach(  # pyright: ignore[reportUnsupportedDunderAll]
    __name__,
    {
        "Analysis": "results.analysis",
        "Catalog": "catalog.catalog",
        "Choices": "compare.compare",
        "Comparison": "results.comparison",
        "Estimate": "common.estimate",
        "Experiment": "results.experiment",
        "Fleet": "catalog.fleet",
        "Index": "parts.heterogeneity.result",
        "JointResult": "parts.joints.result",
        "LinearCoupling": "results.coupling",
        "LocalCoupling": "results.coupling",
        "Margins": "compare.decisions",
        "Options": "signals.stretch",
        "Picture": "present.result_files",
        "Reversal": "results.experiment",
        "analyse_experiment": "experiment.analyse",
        "analyse_fleet": "catalog.fleet",
        "analyse_session": "session.analyse",
        "compare_sessions": "compare.compare",
        "load": "present.result_files",
        "render": "present.text",
    },
)
