"""Messages of one channel and one size, written at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from ...common.arrays import IntArray
from .chunk import BODY_AT

MessageFields: TypeAlias = tuple[int, int, int, int, bytes]
"""Channel id, log time [ns], publish time [ns], sequence number and payload of a message."""

SEQUENCE_MASK = 0xFFFF_FFFF
"""A channel's counter has 32 bits, and begins again."""


@dataclass(frozen=True)
class MessageBatch:
    """Messages of one channel and one size.

    Attributes:
        log_ns: When each was recorded [Unix ns], from 0, shape (n,).
        publish_ns: When each was sampled [Unix ns], from 0, shape (n,).
        sequence: The channel's own counter at the first one.
        records: Room for the head of an MCAP record, which the writer fills, and the message,
            shape (n, BODY_AT + size), C-contiguous.
    """

    channel_id: int
    log_ns: IntArray
    publish_ns: IntArray
    sequence: int
    records: NDArray[np.uint8]

    @cached_property
    def messages(self) -> list[MessageFields]:
        """The messages one by one."""
        length, data = self.records.shape[1], self.records.tobytes()
        times = zip(self.log_ns.tolist(), self.publish_ns.tolist(), strict=True)
        return [
            (
                self.channel_id,
                log_ns,
                publish_ns,
                (self.sequence + k) & SEQUENCE_MASK,
                data[k * length + BODY_AT : (k + 1) * length],
            )
            for k, (log_ns, publish_ns) in enumerate(times)
        ]
