"""Readers of MCAP that the project does not lock, in an interpreter that has them.

``PYTHON bench/foreign_reader.py pybag-sdk|small-mcap FILE TOPIC`` reads the messages of a topic
and prints a JSON object: version, seconds of wall-clock time, messages. pybag decodes them, but
fails where an empty array is followed by another one;
small-mcap, which has no decoder for ROS 2, only hands out their bytes. Nothing of undulog is
imported here.
"""

import json
import sys
import time
from importlib.metadata import version


def pybag(path: str, topic: str) -> int:
    """Decode messages; return how many."""
    from pybag.mcap_reader import McapFileReader

    return sum(1 for _ in McapFileReader.from_file(path).messages(topic))


def small_mcap(path: str, topic: str) -> int:
    """Read the bytes of messages; return how many."""
    from small_mcap import include_topics, read_message

    with open(path, "rb") as stream:  # noqa: PTH123
        return sum(1 for _ in read_message(stream, should_include=include_topics(topic)))


READERS = {"pybag-sdk": pybag, "small-mcap": small_mcap}


def main() -> None:
    """Read and print."""
    library, path, topic = sys.argv[1:]
    READERS[library](path, topic)  # what is imported late is imported now
    start = time.perf_counter()
    count = READERS[library](path, topic)
    took = {"seconds": time.perf_counter() - start, "messages": count}
    print(json.dumps(took | {"version": f"{library} {version(library)}"}))


if __name__ == "__main__":
    main()
