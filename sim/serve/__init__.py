"""The twin as a robot of its own: in its own process, in real time, on a bus over loopback."""
