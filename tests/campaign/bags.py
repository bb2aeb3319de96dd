"""Small whole recordings of ROS, each written by ``rosbags``."""

from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin

from support.ros_bags import (
    BY_CHUNK,
    BY_FILE,
    BY_MESSAGE,
    Filler,
    message,
    ticks,
    write_bag,
    write_split,
)

from .base import Base, files_below

MCAP, DB3 = StoragePlugin.MCAP, StoragePlugin.SQLITE3
BZ2, LZ4 = Writer1.CompressionFormat.BZ2, Writer1.CompressionFormat.LZ4
FOLDERS = {
    "mcap": {"storage": MCAP},
    "chunks": {"storage": MCAP, "compression": BY_CHUNK},
    "mcap-file": {"storage": MCAP, "compression": BY_FILE},
    "mcap-message": {"storage": MCAP, "compression": BY_MESSAGE},
    "db3": {"storage": DB3},
    "db3-file": {"storage": DB3, "compression": BY_FILE},
    "db3-message": {"storage": DB3, "compression": BY_MESSAGE},
}
ROS1 = {
    "plain.bag": {},
    "bz2.bag": {"compression": (BZ2,)},
    "lz4.bag": {"compression": (LZ4,)},
}


def bag_bases(folder):
    """Write every kind of bag to a new folder."""
    folder.mkdir()
    bases = []
    for name, options in FOLDERS.items():
        bases.append(_of_folder(write_bag(folder / name, _fill, **options)))
    halves = (lambda bag: _fill(bag, 0, 60), lambda bag: _fill(bag, 60, 60))
    for name in ("mcap", "mcap-message", "db3", "db3-file"):
        path = write_split(folder / f"split-{name}", halves, **FOLDERS[name])
        bases.append(_of_folder(path))
    for name, options in ROS1.items():
        path = write_bag(folder / name, _fill, chunk_size=20_000, **options)
        bases.append(Base("bag file", name, {name: path.read_bytes()}, (name,)))
    bare = {"bare.db3": (folder / "db3" / "db3.db3").read_bytes()}
    return [*bases, Base("bag file", "bare.db3", bare, ("bare.db3",))]


def _fill(bag, first=0, count=120):
    """Joints in each of the types that they are found in, and a word."""
    filler = Filler(bag)
    for k, tick in enumerate(ticks(3.0, 50)):
        if not first <= k < first + count:
            continue
        filler.state(*tick)
        filler.controller(*tick)
        filler.dynamic(*tick)
        if k % 5 == 0:
            filler.trajectory(*tick, count=3)
            filler.array(*tick)
            word = message(bag.store, "std_msgs/msg/String", data=f"word {k}")
            bag.write("/word", tick[0], word)


def _of_folder(path):
    files = {f"{path.name}/{name}": data for name, data in files_below(path).items()}
    return Base("bag", path.name, files, tuple(files))
