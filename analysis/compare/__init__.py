"""Compare two sessions, or two groups of them: robot and twin, before and after, two surfaces.

::

    from undulog.analysis import compare_sessions
    from undulog.capture import Session

    with Session.open("before.mcap") as before, Session.open("after.mcap") as after:
        print(compare_sessions(before, after))
"""
