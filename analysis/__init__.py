"""Numbers from logs: response, energy, spread over the segments, each with its interval.

::

    from analysis import analyse_session
    from capture import Session

    with Session.open("run.mcap") as session:
        result = analyse_session(session)
    print(result.joints[0].lag_rad, result.warnings)

Names are imported when first used, so that ``import analysis`` costs nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .analyse import analyse_session
    from .experiment import analyse_experiment
    from .result import Analysis, Estimate, Index, JointResult
    from .result_coupling import LocalCoupling
    from .result_experiment import Experiment, Reversal
    from .stretch import Options
    from .table import render

__all__ = [
    "Analysis",
    "Estimate",
    "Experiment",
    "Index",
    "JointResult",
    "LocalCoupling",
    "Options",
    "Reversal",
    "analyse_experiment",
    "analyse_session",
    "render",
]

_HOMES = {
    "Analysis": "result",
    "Estimate": "result",
    "Experiment": "result_experiment",
    "Index": "result",
    "JointResult": "result",
    "LocalCoupling": "result_coupling",
    "Options": "stretch",
    "Reversal": "result_experiment",
    "analyse_experiment": "experiment",
    "analyse_session": "analyse",
    "render": "table",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use."""
    if name not in _HOMES:
        raise AttributeError(f"module 'analysis' has no attribute {name!r}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
