"""The table of docs/explanation/energy.md: energies by the log against the twin's ledger.

``.venv/bin/python studies/energy_tables.py`` runs all shipped scenarios, which takes some minutes,
and prints the table as Markdown; ``--write`` puts it into the page. With names, those only.
"""

from __future__ import annotations

import argparse
import dataclasses
import tempfile
from pathlib import Path

from undulog.analysis.parts.energy.measure import (
    TERMS,
    booked_energies,
    joint_energies,
    whole_robot,
)
from undulog.analysis.results.analysis import Analysis
from undulog.analysis.session.analyse import measure_session
from undulog.analysis.signals.columns import RESPONSE_TOPIC, read_columns
from undulog.capture import Session
from undulog.sim import load_scenario, scenario_names
from undulog.sim.scenario.scenario import Kernels
from undulog.sim.twin.recording import record

BAR = 0.005
"""Largest error of an energy of the whole robot."""

NET_FLOOR = 0.05
"""E_net may vanish: its error is held against at least this part of E_abs."""

PAGE = Path(__file__).parents[1] / "docs/explanation/energy.md"
BEGIN, END = "<!-- table by energy_tables.py -->", "<!-- end of the table -->"
TITLES = {"net": "E_net", "plus": "E_plus", "abs": "E_abs", "el": "E_el", "el_clipped": "E_el+"}


@dataclasses.dataclass(frozen=True)
class Figures:
    """One session's energies against its ledger.

    Attributes:
        booked: By the ledger [J], by name as in ``TITLES``.
        errors: Of the accumulated powers, shares of the booked energy (E_net: see ``NET_FLOOR``).
        sampled: Of products of samples alone, likewise.
        balance: What is left of the ledger's mechanical and electrical balance, shares of E_abs.
        analysis: All results.
    """

    booked: dict[str, float]
    errors: dict[str, float]
    sampled: dict[str, float]
    balance: tuple[float, float]
    analysis: Analysis

    @property
    def flags(self) -> list[tuple[str, str]]:
        """Joints and what their sensors are blamed for; nothing, on the twin."""
        return [
            (artefact.joint, artefact.flag)
            for artefact in self.analysis.artefacts
            if artefact.about == "sensor"
        ]


def figures(path):
    """Hold a recorded session's energies against its ledger, over the analysed window."""
    with Session.open(path) as session:
        measured = measure_session(session)
        ledger = booked_energies(session, measured.span)
        columns = read_columns(session, "/joint_commands", RESPONSE_TOPIC, _ignore)
        without = dataclasses.replace(columns, powers={joint: {} for joint in columns.powers})
        products = joint_energies(session, without, (), measured.span, _ignore)
    booked = {name: ledger[term] for name, (*_, term) in TERMS.items()}
    scale = booked | {"net": max(abs(booked["net"]), NET_FLOOR * booked["abs"])}

    def errors(energies):
        whole = whole_robot(energies.values())
        return {name: (whole[name] - booked[name]) / abs(scale[name]) for name in TERMS}

    left = (ledger[f"{kind}_residual"] / booked["abs"] for kind in ("mechanical", "electrical"))
    parts = errors(measured.energies), errors(products), tuple(left)
    return Figures(booked, *parts, measured.analysis)


def run(name, folder):
    """Run a shipped scenario and hold its energies against its ledger."""
    path = Path(folder) / f"{name}.mcap"
    record(load_scenario(name), path, kernels=Kernels.NUMBA, force=True)
    result = figures(path)
    path.unlink()
    return result


def row(name, result):
    """Return one row of the table."""
    booked = (result.booked[term] for term in TITLES)
    cells = [f"{energy:.3g}" if abs(energy) < 1000 else f"{energy:.0f}" for energy in booked]
    cells += [f"{100 * max(abs(error) for error in result.errors.values()):.4f}"]
    cells += [f"{100 * result.sampled[term]:+.2f}" for term in TITLES]
    return f"| `{name}` | {' | '.join(cells)} |"


def table(rows):
    """Return the table as Markdown."""
    heads = ["scenario", *(f"{title} [J]" for title in TITLES.values()), "largest error [%]"]
    heads += [f"{title} by samples [%]" for title in TITLES.values()]
    ruler = "|---|" + "---:|" * (len(heads) - 1)
    return "\n".join([f"| {' | '.join(heads)} |", ruler, *rows])


def _ignore(_):
    """What is missing has been said."""


def main():
    """Print the table, or write it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="scenarios; all that are shipped by default")
    parser.add_argument("--write", action="store_true", help="put the table into the page")
    parser.add_argument("--quick", action="store_true", help="one short scenario")
    options = parser.parse_args()
    if options.quick:
        options.names = ["snake13-horizontal-pi2"]
    rows, worst, left, flags = [], 0.0, [0.0, 0.0], []
    with tempfile.TemporaryDirectory() as folder:
        for name in options.names or scenario_names():
            result = run(name, folder)
            rows.append(row(name, result))
            worst = max(worst, *(abs(error) for error in result.errors.values()))
            left = [
                max(largest, abs(residual))
                for largest, residual in zip(left, result.balance, strict=True)
            ]
            flags += [(name, *flag) for flag in result.flags]
            print(rows[-1], flush=True)
    if options.write:
        before, _, rest = PAGE.read_text().partition(BEGIN)
        after = rest.partition(END)[2]
        PAGE.write_text(f"{before}{BEGIN}\n\n{table(rows)}\n\n{END}{after}")
    else:
        print(f"\n{table(rows)}")
    print(f"sensors blamed: {flags or 'none'}")
    print(f"largest error {100 * worst:.4f} %, bar {100 * BAR:g} %")
    print(f"the ledger's own balance closes within {100 * left[0]:.3f} % and {100 * left[1]:.4f} %")


if __name__ == "__main__":
    main()
