"""Collections of garbage that fit into a control period."""

from __future__ import annotations

import gc
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def quick_collections() -> Generator[None]:
    """Garbage is looked for among new objects only: all of them at once take longer than a tick.

    Yields:
        Nothing.
    """
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()
