"""Cost of keeping a message: the recorder's sink and its parts, plain files, mcap.Writer alone.

All take the same messages in the same run, in turn, so that the ratios count: of the calling
thread's own processor time, which other work on the machine hardly disturbs. After a kill the
recorder's sink, its write-ahead log and the flushed file have every message; a plain session file
and mcap.Writer lose their open chunk. The slowest calls are shown, too: a recorder's loop must bear
them. They are those that finish a chunk; how long that takes for which chunk size is the second
table.

Run: python bench/durable.py [--messages 50000] [--runs 3] [--folder DIR]
"""

from __future__ import annotations

import struct
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from mcap.records import Channel
from mcap.writer import Writer
from measuring import arguments, in_turn
from records import compared, versions

from undulog.capture.log.wal.writer import WriteAheadLog
from undulog.capture.log.write import durable_sink
from undulog.capture.log.write.durable_sink import DurableSink
from undulog.capture.log.write.mcap_sink import McapSink

EPOCH_NS = 1_700_000_000_000_000_000
SIZES = (100, 1000)
CHUNKS = (1 << 18, 1 << 19, 1 << 20)
CHANNEL = Channel(id=1, topic="/t", message_encoding="cdr", metadata={}, schema_id=0)
HEAD = struct.Struct("<IHIQQ")

Accept = Callable[[int, bytes], object]
"""Takes one message: its number and payload."""


@contextmanager
def recorders_sink(folder: Path) -> Iterator[Accept]:
    """Write-ahead log, chunks to the disk in a thread, synced."""
    yield from _sink(DurableSink(folder / "durable.mcap"))


@contextmanager
def session_file(folder: Path) -> Iterator[Accept]:
    """Without a write-ahead log, as the twin writes."""
    yield from _sink(McapSink(folder / "plain.mcap"))


def _sink(sink: DurableSink | McapSink) -> Iterator[Accept]:
    sink.define(CHANNEL)
    yield lambda number, payload: sink.write(1, EPOCH_NS + number, EPOCH_NS, number, payload)
    sink.close(())


@contextmanager
def write_ahead_log(folder: Path) -> Iterator[Accept]:
    """The write-ahead log alone, its segments released as a writer does."""
    with WriteAheadLog(folder / "log.wal") as wal:
        wal.define(CHANNEL)

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
    with (folder / "flushed.bin").open("wb") as file:

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            file.write(HEAD.pack(len(payload), 1, number, time_ns, time_ns) + payload)
            file.flush()

        yield accept


@contextmanager
def mcap_writer(folder: Path) -> Iterator[Accept]:
    """The MCAP library as it comes: chunks of 1 MiB, zstd."""
    with (folder / "library.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channel = writer.register_channel("/t", "cdr", 0)

        def accept(number: int, payload: bytes) -> None:
            time_ns = EPOCH_NS + number
            writer.add_message(channel, time_ns, payload, time_ns, number)

        yield accept
        writer.finish()


WAYS = {
    "DurableSink": recorders_sink,
    "McapSink": session_file,
    "write-ahead log": write_ahead_log,
    "file, flush() each": flushed_file,
    "mcap.Writer": mcap_writer,
}


def measure(accept: Accept, payloads: list[bytes]) -> np.ndarray:
    """Return the time of each call [ns], with two looks at the clock, the same for all."""
    clock = time.perf_counter_ns
    took = np.empty(len(payloads), dtype=np.int64)
    for number, payload in enumerate(payloads):
        start = clock()
        accept(number, payload)
        took[number] = clock() - start
    return took


def processor_time(accept: Accept, payloads: list[bytes]) -> float:
    """Return the calling thread's processor time a message [us]."""
    start = time.thread_time_ns()
    for number, payload in enumerate(payloads):
        accept(number, payload)
    return (time.thread_time_ns() - start) / len(payloads) / 1e3


def sensor_like(count: int, size: int) -> list[bytes]:
    """Return payloads in which the upper half of each float changes little."""
    values = np.random.default_rng(1).normal(1.0, 1e-3, size=(count, -(-size // 8)))
    return [row.tobytes()[:size] for row in values]


def run_in(folder: Path | None, way: str, work: Callable, payloads: list[bytes]):
    """Return the result of a measurement of one way, in a new folder."""
    with tempfile.TemporaryDirectory(dir=folder) as place, WAYS[way](Path(place)) as accept:
        return work(accept, payloads)


def compare(payloads: list[bytes], runs: int, folder: Path | None) -> None:
    """Print the cost of each way."""
    kinds = measure, processor_time
    works = [partial(run_in, folder, way, kind, payloads) for way in WAYS for kind in kinds]
    results = in_turn(runs, *works)
    took, processor_us = (dict(zip(WAYS, results[k::2], strict=True)) for k in range(2))
    means = {way: float(np.median(times)) for way, times in processor_us.items()}
    peer = f"{versions('mcap')} Writer"
    what = f"keep a message of {len(payloads[0])} B, recorder's sink"
    compared(what, processor_us["DurableSink"], processor_us["mcap.Writer"], peer, unit="us")
    for way, results in took.items():
        every = np.concatenate(results) / 1e3
        p50, p999, worst = np.percentile(every, (50, 99.9, 100))
        print(
            f"  {way:<18} processor {means[way]:6.2f} "
            f"({means[way] / means['mcap.Writer']:4.2f} x)   mean {every.mean():6.2f}   "
            f"p50 {p50:6.2f}   p99.9 {p999:8.1f}   max {worst:9.1f}"
        )


def chunk_sizes(payloads: list[bytes], folder: Path | None) -> None:
    """Print the time of finishing a chunk, and how well it compresses, by size."""
    total = sum(map(len, payloads))
    usual = durable_sink.CHUNK_SIZE
    for size in CHUNKS:
        durable_sink.CHUNK_SIZE = size
        with tempfile.TemporaryDirectory(dir=folder) as place:
            with recorders_sink(Path(place)) as accept:
                took = measure(accept, payloads)
            stored = (Path(place) / "durable.mcap").stat().st_size
        slowest = np.sort(took)[-max(1, total // size) :] / 1e6
        print(
            f"  chunk {size >> 10:5d} KiB   finishing one: median {np.median(slowest):5.2f} ms, "
            f"max {slowest[-1]:5.2f} ms   stored {stored / total:.3f} of the payload"
        )
    durable_sink.CHUNK_SIZE = usual


def main() -> None:
    """Measure and print."""
    parser = arguments(__doc__, messages=50_000, runs=3)
    parser.add_argument("--folder", type=Path, help="a folder on the disk to measure")
    options = parser.parse_args()
    for size in SIZES:
        payloads = sensor_like(options.messages, size)
        print(f"payload {size} B, {options.messages} messages, {options.runs} runs [us a message]")
        compare(payloads, options.runs, options.folder)
        chunk_sizes(payloads, options.folder)


if __name__ == "__main__":
    main()
