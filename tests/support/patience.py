"""What the tests that wait for other processes and threads share."""

import time


def wait_for(condition, what, seconds=60.0):
    """What a condition gives as soon as it holds."""
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited {seconds} s for {what}"
        time.sleep(0.01)
    return found
