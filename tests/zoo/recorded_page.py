"""The table of recordings of docs/explanation/faults.md: ``PYTHONPATH=tests python -m
zoo.recorded_page`` prints it, where the recordings are.

Nobody broke these robots: what the first sentence says is compared with a straight fit of each
joint that undulog takes no part in.
"""

import numpy as np

from .adapter import stated
from .independent_fit import independent_fit
from .real_faults import columns
from .recordings import recordings

LEAST_MOVED_RAD = np.radians(3.0)
"""Range of a command below which a fit says nothing [rad]."""


def lines():
    """Yield the table as Markdown."""
    yield "| recording | first sentence | joints that don't follow | independent fit |"
    yield "|---|---|---|---|"
    for name, read in recordings().items():
        signals = read()
        statement = stated(signals)
        fits = [
            independent_fit(*columns(signals, j), (None, None))
            for j in range(len(signals.names))
            if np.ptp(signals.commands[:, j]) > LEAST_MOVED_RAD
        ]
        refuted = sum(
            independent_fit(
                *columns(signals, signals.names.index(accusation.joint)),
                (accusation.since_s, accusation.until_s),
            ).refutes
            for accusation in statement.accused
        )
        accused = (
            f"{len(statement.accused)}, {refuted} of them refuted" if statement.accused else "none"
        )
        sentence = (statement.sentence or statement.refused).replace("|", "/")
        yield f"| {name} | {sentence} | {accused} | {_range(fits)} |"


def _range(fits):
    """Say gains, delays and explained shares of joints that are asked to move."""
    if not fits:
        return "no joint is asked to move by 3 degrees"
    low, high = (of(fit.gain for fit in fits) for of in (min, max))
    least = min(fit.explained for fit in fits)
    delays = [1e3 * fit.delay_s for fit in fits]
    text = f"gain {low:.2f} to {high:.2f}, delay {min(delays):.0f} to {max(delays):.0f} ms"
    return f"{text}, r² at least {least:.2f}, {len(fits)} joints"


if __name__ == "__main__":
    print("\n".join(lines()))
