"""A process of its own that listens to a bus and writes down every frame: python-can and cantools.

Nothing of undulog is in it. Arguments: port, bus, DBC file, output. One JSON object a line: ``t_s``
(the machine's monotonic clock), ``bus_s`` (the time on the bus), ``name`` (of the message), and its
signals in the units of the DBC. It says ``listening`` on stdout, and ends with SIGTERM.
"""

import json
import signal
import sys
import time

import can
import cantools


def main():
    """Listen until SIGTERM."""
    port, channel, database, output = sys.argv[1:]
    messages = {
        message.frame_id: message for message in cantools.database.load_file(database).messages
    }
    going = True

    def end(_number, _frame):
        nonlocal going
        going = False

    signal.signal(signal.SIGTERM, end)
    with (
        can.Bus(interface="socketcand", host="127.0.0.1", port=int(port), channel=channel) as bus,
        open(output, "w", buffering=1) as heard,  # noqa: PTH123 - a line is there when it is written
    ):
        print("listening", flush=True)
        while going:
            try:
                frame = bus.recv(0.1)
            except (can.CanError, OSError):
                break  # the robot is gone
            if frame is None or frame.is_error_frame:
                continue
            message = messages.get(frame.arbitration_id)
            report = {
                "t_s": time.monotonic(),
                "bus_s": frame.timestamp,
                "id": frame.arbitration_id,
                "name": message.name if message else None,
                "data": frame.data.hex(),
                "signals": message.decode(frame.data, decode_choices=False) if message else {},
            }
            heard.write(json.dumps(report) + "\n")


main()
