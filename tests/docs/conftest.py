"""Long parts of the manual are built again only if what they are built from has changed."""

import os

import built_from

from support.paths import SHARED


def pytest_collection_modifyitems(config, items):
    """Leave out tests of a part that ``make pages`` built from what is here now."""
    if os.environ.get("UNDULOG_BUILD_PAGES") == "1":
        return
    parts = {item: item.get_closest_marker("built") for item in items}
    current = {one.args[0] for one in parts.values() if one}
    current = {part for part in current if built_from.is_current(part, SHARED)}
    left_out = [item for item, one in parts.items() if one and one.args[0] in current]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if item not in left_out]
