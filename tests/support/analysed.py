"""What the analysis finds in the files of sessions: of one, or of several as one experiment."""

from undulog.analysis import analyse_experiment, analyse_session
from undulog.capture import Session


def analysed(path, options=None):
    with Session.open(path) as session:
        return analyse_session(session, options)


def experiment(paths):
    """Analyse sessions as one experiment; one session at a time is open."""

    def opened():
        for path in paths:
            with Session.open(path) as session:
                yield session

    return analyse_experiment(opened())
