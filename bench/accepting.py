"""What the benches of keeping messages share: the MCAP library as a peer, the time of a call."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.writer import Writer
from numpy.typing import NDArray

EPOCH_NS = 1_700_000_000_000_000_000

Accept = Callable[[int, bytes], object]
"""Takes one message: its number and payload."""

_copies = itertools.count()


def new_file(folder: Path, suffix: str) -> Path:
    """A name that no file has yet.

    Args:
        folder: Where.
        suffix: How it ends, e.g. ``.mcap``.

    Returns:
        Its path.
    """
    return folder / f"{next(_copies)}{suffix}"


@contextmanager
def mcap_writer(folder: Path) -> Iterator[Accept]:
    """The MCAP library as it comes: chunks of 1 MiB, zstd."""
    with new_file(folder, ".mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channel = writer.register_channel("/t", "cdr", 0)

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            writer.add_message(channel, time_ns, payload, time_ns, number)

        yield accept
        writer.finish()


def measure(accept: Accept, payloads: list[bytes]) -> NDArray[np.int64]:
    """Time of each call [ns]; the two looks at the clock are in it, the same for all."""
    clock = time.perf_counter_ns
    took = np.empty(len(payloads), dtype=np.int64)
    for number, payload in enumerate(payloads):
        start = clock()
        accept(number, payload)
        took[number] = clock() - start
    return took
