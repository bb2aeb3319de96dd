"""Cost of accepting a message: write-ahead log, plain file with flush(), mcap.Writer.

All take the same messages in the same run, in turn, so that the ratios count. After a kill the
write-ahead log and the flushed file have every message; mcap.Writer alone loses its open chunk.
The slowest appends are shown too: they are what a recorder's loop must bear.

Run: python bench/wal.py [--messages 50000] [--runs 5] [--folder DIR]
"""

from __future__ import annotations

import argparse
import struct
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from accepting import EPOCH_NS, Accept, mcap_writer, measure, new_file
from mcap.records import Channel
from numpy.typing import NDArray

from undulog.capture.log.wal.writer import WriteAheadLog

SIZES = (100, 1000)
HEAD = struct.Struct("<IHIQQ")


@contextmanager
def write_ahead_log(folder: Path) -> Iterator[Accept]:
    """Ours, its segments released as a writer would."""
    with WriteAheadLog(new_file(folder, ".wal")) as wal:
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
    with new_file(folder, ".bin").open("wb") as file:

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            file.write(HEAD.pack(len(payload), 1, number, time_ns, time_ns) + payload)
            file.flush()

        yield accept


WAYS = {
    "write-ahead log": write_ahead_log,
    "file, flush() each": flushed_file,
    "mcap.Writer": mcap_writer,
}


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
