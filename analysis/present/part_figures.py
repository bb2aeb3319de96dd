"""Draw the figures that parts of the analysis describe (:class:`.analysis.parts.shown.Figure`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from undulog.capture.common.errors import UsageError
from undulog.capture.common.palette import joint_hex

from ..common.estimate import Estimate
from ..common.formats import estimate, short
from .bode import MARKERS
from .svg import Drawing, band, drawing, inline_svg, key, legend

if TYPE_CHECKING:
    from ..parts.shown import Curve, Figure

_NAME = 14
"""Characters of a name in the legend."""


def draw(figure: Figure, title: str, prefix: str) -> Drawing:
    """Draw lines with their intervals over one axis.

    Args:
        title: Of the section that it is in.
        prefix: For identifiers, unique in the page.

    Raises:
        UsageError: If it has more curves than can be told apart.
    """
    curves = figure.curves
    if len(curves) > len(MARKERS):
        raise UsageError(f"{title}: a figure of {len(curves)} curves; at most {len(MARKERS)}")
    colors = joint_hex(len(curves)) if curves else ()
    tooltips: dict[str, str] = {}
    with drawing(2.8) as canvas:
        axes = canvas.subplots()
        handles: list[object] = []
        for k, (curve, color, marker) in enumerate(zip(curves, colors, MARKERS, strict=False)):
            style = {"color": color, "linewidth": 1.4, "marker": marker, "markersize": 3.6}
            x, y = np.array(curve.x, float), np.array(curve.y, float)
            axes.plot(x, y, gid=f"curve-{k}", **style)
            tooltips[f"curve-{k}"] = curve.name
            if curve.ci95:
                ends = np.array([e or (np.nan, np.nan) for e in curve.ci95], dtype=np.float64)
                sure = np.isfinite(ends[:, 0])
                band(axes, x[sure], *ends[sure].T, color=color, alpha=0.18)
            label = short(curve.name, _NAME)
            handles.append(key(color=color, linewidth=1.4, marker=marker, label=label))
        axes.set_xlabel(figure.x_label)
        axes.set_ylabel(figure.y_label)
        legend(canvas, *handles)
        words = "; ".join(_in_words(curve) for curve in curves) or "no curve"
        svg = inline_svg(canvas, prefix, title, f"{figure.y_label} over {figure.x_label}: {words}.")
    return Drawing(svg, figure.caption)


def _in_words(curve: Curve) -> str:
    values = [value for value in curve.y if value is not None]
    if not values:
        return f"{curve.name} has no value"
    low, high = (estimate(Estimate(end)) for end in (min(values), max(values)))
    return f"{curve.name} from {low} to {high}"
