"""The table of docs/explanation/faults.md: ``PYTHONPATH=tests python -m zoo.page`` prints it."""

from .faults import FAULTS, plant
from .robot import Channels, draw

COLUMNS = {
    "positions": Channels(),
    "and a velocity of its own": Channels(velocity="true"),
    "and effort": Channels(effort=True),
    "and a second sensor": Channels(second=True),
}
"""A velocity that is derived from the same positions adds nothing to the first column."""


def lines():
    """Yield the table as Markdown; a fault that is planted at several joints has one line."""
    yield "| fault | what it looks like | " + " | ".join(COLUMNS) + " |"
    yield "|---|---|" + "---|" * len(COLUMNS)
    shown_before = []
    for name, fault in FAULTS.items():
        if name.startswith("two at once") or (fault.plant in shown_before):
            continue
        shown_before.append(fault.plant)
        first, *cells = [_cell(fault, channels) for channels in COLUMNS.values()]
        shown = [first, *("same" if cell == first and cell != "-" else cell for cell in cells)]
        looks = str(fault.plant.__doc__).rstrip(".")
        yield " | ".join([f"| {name.split(', head')[0]}", looks, *shown]) + " |"


def _cell(fault, channels):
    if fault.channels is not None and channels not in fault.channels:
        return "-"
    _, truth = plant(fault, draw(1, small=True, channels=channels, joints=fault.joints), 1)
    if truth.undecided:
        return "joints differ; which one can't be decided"
    return _kinds(truth.joints[0]) if truth.joints else "nothing"


def _kinds(truth):
    kinds = ", ".join(f"`{kind}`" for kind in sorted(truth.allowed))
    outside = truth.stands_out and f"stands out by {' or '.join(sorted(truth.stands_out))}"
    return "; or ".join(filter(None, (kinds, outside)))


if __name__ == "__main__":
    print("\n".join(lines()))
