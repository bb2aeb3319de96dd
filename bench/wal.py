"""Cost of accepting a message: write-ahead log, plain file with flush(), mcap.Writer.

All take the same messages in the same run, in turn, so that the ratios count. After a kill the
write-ahead log and the flushed file have every message; mcap.Writer alone loses its open chunk.
The slowest appends are shown too: they are what a recorder's loop must bear.

Run: python bench/wal.py [--messages 50000] [--runs 5] [--folder DIR]
"""

from __future__ import annotations

import argparse
import itertools
import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from mcap.records import Channel
from mcap.writer import Writer
from numpy.typing import NDArray

from capture.log.wal import WriteAheadLog

EPOCH_NS = 1_700_000_000_000_000_000
SIZES = (100, 1000)
HEAD = struct.Struct("<IHIQQ")

Accept = Callable[[int, bytes], object]
"""Takes one message: its number and payload."""

_copies = itertools.count()


@contextmanager
def write_ahead_log(folder: Path) -> Iterator[Accept]:
    """Ours, its segments released as a writer would."""
    with WriteAheadLog(folder / f"{next(_copies)}.wal") as wal:
        wal.define(Channel(id=1, topic="/t", message_encoding="cdr", metadata={}, schema_id=0))

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            position = wal.append(1, time_ns, time_ns, number, payload)
            if not position % 10_000:
                wal.release(position)

        yield accept
        wal.release(wal.position)


@contextmanager
def flushed_file(folder: Path) -> Iterator[Accept]:
    """A buffered file, flushed to the kernel after each record."""
    with (folder / f"{next(_copies)}.bin").open("wb") as file:

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            file.write(HEAD.pack(len(payload), 1, number, time_ns, time_ns) + payload)
            file.flush()

        yield accept


@contextmanager
def mcap_writer(folder: Path) -> Iterator[Accept]:
    """The MCAP library as it comes: chunks of 1 MiB, zstd."""
    with (folder / f"{next(_copies)}.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channel = writer.register_channel("/t", "cdr", 0)

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            writer.add_message(channel, time_ns, payload, time_ns, number)

        yield accept
        writer.finish()


WAYS = {
    "write-ahead log": write_ahead_log,
    "file, flush() each": flushed_file,
    "mcap.Writer": mcap_writer,
}


def measure(accept: Accept, payloads: list[bytes]) -> NDArray[np.int64]:
    """Time of each call [ns]; the two looks at the clock are in it, the same for all."""
    clock = time.perf_counter_ns
    took = np.empty(len(payloads), dtype=np.int64)
    for number, payload in enumerate(payloads):
        start = clock()
        accept(number, payload)
        took[number] = clock() - start
    return took


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--messages", type=int, default=50_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--folder", type=Path, help="a folder on the disk to measure")
    options = parser.parse_args()
    rng = np.random.default_rng(1)
    for size in SIZES:
        # Sensor-like bytes: the upper half of each float changes little.
        values = rng.normal(1.0, 1e-3, size=(options.messages, -(-size // 8)))
        payloads = [row.tobytes()[:size] for row in values]
        took: dict[str, list[NDArray[np.int64]]] = {way: [] for way in WAYS}
        for _ in range(options.runs):
            for way, opened in WAYS.items():
                with (
                    tempfile.TemporaryDirectory(dir=options.folder) as folder,
                    opened(Path(folder)) as accept,
                ):
                    took[way].append(measure(accept, payloads))
        print(f"payload {size} B, {options.messages} messages, {options.runs} runs [us a message]")
        means = {way: np.median([run.mean() for run in runs]) / 1e3 for way, runs in took.items()}
        ours = means["write-ahead log"]
        for way, runs in took.items():
            p50, p999, worst = (
                float(np.percentile(np.concatenate(runs), q)) / 1e3 for q in (50, 99.9, 100)
            )
            print(
                f"  {way:<20} mean {means[way]:6.2f} ({means[way] / ours:4.1f} x)   "
                f"p50 {p50:6.2f}   p99.9 {p999:8.1f}   max {worst:9.1f}"
            )


if __name__ == "__main__":
    main()
