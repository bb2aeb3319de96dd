"""A sender with sequence numbers of its own; nothing of undulog is in it.

Arguments: socket, log, frames a second, frames a packet, seconds. Each frame's data is its number
among those that the kernel accepted. Each accepted packet is logged as two little-endian
64-bit numbers: monotonic time, frames so far. Reports at the end, as JSON: accepted, refused.
"""

import errno
import json
import os
import socket
import struct
import sys
import time


def main():
    path, log, rate, per_packet, seconds = sys.argv[1:]
    rate, per_packet, seconds = float(rate), int(per_packet), float(seconds)
    deadline = time.monotonic() + 60
    link = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    while True:
        try:
            link.connect(path)
            break
        except OSError:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.02)
    link.setblocking(False)
    began, accepted, refused, sent_at = time.monotonic(), 0, 0, 0
    with open(log, "wb", buffering=0) as kept:  # noqa: PTH123
        while (now := time.monotonic() - began) < seconds:
            due = int(now * rate) - sent_at
            while due >= per_packet:
                t_ns = time.time_ns()
                rows = b"".join(
                    struct.pack("<QQIBBxxQ", t_ns, t_ns, 0x100, 8, 0, accepted + k)
                    for k in range(per_packet)
                )
                try:
                    link.send(rows)
                    accepted += per_packet
                    kept.write(struct.pack("<QQ", time.monotonic_ns(), accepted))
                except BlockingIOError:
                    refused += per_packet
                except OSError as error:
                    if error.errno not in (errno.EPIPE, errno.ECONNRESET, errno.ENOTCONN):
                        raise
                    print(json.dumps({"accepted": accepted, "refused": refused, "ended": True}))
                    return
                due -= per_packet
                sent_at += per_packet
            time.sleep(0.001)
    link.close()
    print(json.dumps({"accepted": accepted, "refused": refused, "ended": False}))


if __name__ == "__main__":
    os.nice(-5) if os.geteuid() == 0 else None
    main()
