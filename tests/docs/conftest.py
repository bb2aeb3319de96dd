"""Long parts of the manual are built again only if what they are built from has changed."""

import os

import built_from

from support.paths import SHARED


def pytest_collection_modifyitems(config, items):
    """Leave out tests of a part that ``make pages`` built from what is here now."""
    if os.environ.get("UNDULOG_BUILD_PAGES") == "1":
        return
    marked = [(item, item.get_closest_marker("built")) for item in items]
    parts = {marker.args[0] for _, marker in marked if marker}
    current = {part for part in parts if built_from.is_current(part, SHARED)}
    left_out = {item for item, marker in marked if marker and marker.args[0] in current}
    config.hook.pytest_deselected(items=list(left_out))
    items[:] = [item for item in items if item not in left_out]
