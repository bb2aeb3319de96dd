"""The offline report: one self-contained HTML page that answers first and proves after.

::

    from undulog.analysis.present.page.page import render
    from undulog.capture import Session

    with Session.open("run.mcap") as session:
        page = render(analysis, session)  # one page; a sequence of both for several sessions

It needs the extra ``report``.
"""
