"""Sessions side by side: bodies overlaid, plots of all of them, and their differences.

::

    from pathlib import Path
    from undulog.replay.overlay.write import combine_sessions

    both = combine_sessions([Path("robot.mcap"), Path("twin.mcap")], Path("both.rrd"))
    print(both.outcomes["twin"].comparison, both.placements["twin"])
"""
