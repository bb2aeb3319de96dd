"""Cost of keeping a message: the recorder's sink, a plain session file, mcap.Writer alone.

All take the same messages in the same run, in turn, so that the ratios count: of the calling
thread's own processor time, which other work on the machine hardly disturbs. The slowest calls
are shown too: a recorder's loop must bear them. They are those that finish a chunk; how long that
takes for which chunk size is the second table.

Run: python bench/durable.py [--messages 50000] [--runs 3] [--folder DIR]
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from accepting import EPOCH_NS, Accept, mcap_writer, measure
from mcap.records import Channel
from numpy.typing import NDArray

from undulog.capture.log.sinks import durable_sink
from undulog.capture.log.sinks.durable_sink import DurableSink
from undulog.capture.log.sinks.mcap_sink import McapSink

SIZES = (100, 1000)
CHUNKS = (1 << 18, 1 << 19, 1 << 20)
CHANNEL = Channel(id=1, topic="/t", message_encoding="cdr", metadata={}, schema_id=0)


@contextmanager
def recorders_sink(folder: Path) -> Iterator[Accept]:
    """Write-ahead log, chunks to the disk in a thread, synced."""
    sink = DurableSink(folder / "durable.mcap")
    sink.define(CHANNEL)
    yield lambda number, payload: sink.write(1, EPOCH_NS + number, EPOCH_NS, number, payload)
    sink.close(())


@contextmanager
def session_file(folder: Path) -> Iterator[Accept]:
    """Without a write-ahead log, as the twin writes."""
    sink = McapSink(folder / "plain.mcap")
    sink.define(CHANNEL)
    yield lambda number, payload: sink.write(1, EPOCH_NS + number, EPOCH_NS, number, payload)
    sink.close(())


WAYS = {
    "DurableSink": recorders_sink,
    "McapSink": session_file,
    "mcap.Writer": mcap_writer,
}


def processor_time(accept: Accept, payloads: list[bytes]) -> float:
    """The calling thread's processor time a message [us]."""
    start = time.thread_time_ns()
    for number, payload in enumerate(payloads):
        accept(number, payload)
    return (time.thread_time_ns() - start) / len(payloads) / 1e3


def sensor_like(count: int, size: int) -> list[bytes]:
    """Payloads in which the upper half of each float changes little."""
    values = np.random.default_rng(1).normal(1.0, 1e-3, size=(count, -(-size // 8)))
    return [row.tobytes()[:size] for row in values]


@contextmanager
def fresh(folder: Path | None) -> Iterator[Path]:
    """A folder for one run."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        yield Path(place)


def compare(payloads: list[bytes], runs: int, folder: Path | None) -> None:
    """Print the cost of each way."""
    took: dict[str, list[NDArray[np.int64]]] = {way: [] for way in WAYS}
    own: dict[str, list[float]] = {way: [] for way in WAYS}
    for _ in range(runs):
        for way, opened in WAYS.items():
            with fresh(folder) as place, opened(place) as accept:
                took[way].append(measure(accept, payloads))
            with fresh(folder) as place, opened(place) as accept:
                own[way].append(processor_time(accept, payloads))
    means = {way: float(np.median(found)) for way, found in own.items()}
    for way, found in took.items():
        every = np.concatenate(found)
        p50, p999, worst = (float(np.percentile(every, q)) / 1e3 for q in (50, 99.9, 100))
        print(
            f"  {way:<12} processor {means[way]:6.2f} "
            f"({means[way] / means['mcap.Writer']:4.2f} x)   "
            f"p50 {p50:6.2f}   p99.9 {p999:8.1f}   max {worst:9.1f}"
        )


def chunk_sizes(payloads: list[bytes], folder: Path | None) -> None:
    """Print what finishing a chunk takes, and how well it compresses, by size."""
    total = sum(map(len, payloads))
    usual = durable_sink.CHUNK_SIZE
    for size in CHUNKS:
        durable_sink.CHUNK_SIZE = size
        with fresh(folder) as place:
            with recorders_sink(place) as accept:
                took = measure(accept, payloads)
            stored = (place / "durable.mcap").stat().st_size
        chunks = max(1, total // size)
        slowest = np.sort(took)[-chunks:] / 1e6
        print(
            f"  chunk {size >> 10:5d} KiB   finishing one: median {np.median(slowest):5.2f} ms, "
            f"max {slowest[-1]:5.2f} ms   stored {stored / total:.3f} of the payload"
        )
    durable_sink.CHUNK_SIZE = usual


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--messages", type=int, default=50_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="a folder on the disk to measure")
    options = parser.parse_args()
    for size in SIZES:
        payloads = sensor_like(options.messages, size)
        print(f"payload {size} B, {options.messages} messages, {options.runs} runs [us a message]")
        compare(payloads, options.runs, options.folder)
        chunk_sizes(payloads, options.folder)


if __name__ == "__main__":
    main()
