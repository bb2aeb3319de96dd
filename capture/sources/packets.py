"""What a packet to a ``unix:`` source looks like.

::

    [sequence:u64 dropped:u64]   optional head, 16 bytes, little-endian
    record[0..256]               32 bytes each: capture.log.frames.FRAME_DTYPE

``sequence`` is the running number of the packet's first frame among all that the sender had, from
0 at the connection's start; ``dropped`` how many of them it could not send. A head alone is a valid
packet: it tells of frames dropped after the last one sent. Whether there is a head is told by the
size.
"""

from __future__ import annotations

import struct

from ..log.messages.frames import FRAME_DTYPE

RECORD_SIZE = FRAME_DTYPE.itemsize
"""Bytes of one frame."""
MOST_RECORDS = 256
"""Frames in one packet at most."""
HEAD = struct.Struct("<QQ")
"""Head: sequence, dropped."""
LONGEST = HEAD.size + MOST_RECORDS * RECORD_SIZE
"""Bytes of the longest packet."""
