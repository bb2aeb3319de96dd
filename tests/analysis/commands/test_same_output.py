"""Commands that write one output at the same time: it is that of one of them, whole."""

import pytest

from support.processes import UNDULOG, start, undulog


@pytest.mark.nightly
@pytest.mark.parametrize("verb", ["analyse", "report"])
def test_an_output_that_two_write_at_once_is_one_of_the_two(verb, tmp_path):
    undulog("sim", "run", "flat", "-o", "run.mcap", "--duration", "6", cwd=tmp_path, code=0)
    suffix = {"analyse": "json", "report": "html"}[verb]
    choices = [("--start", "0.5"), ("--start", "1.5")]
    alone = []
    for number, choice in enumerate(choices):
        output = f"alone{number}.{suffix}"
        undulog(verb, "run.mcap", *choice, "-o", output, cwd=tmp_path, code=0)
        alone.append(_without_time((tmp_path / output).read_text(), output))
    assert len(set(alone)) == len(choices)
    output = f"together.{suffix}"
    running = [
        start(*UNDULOG, verb, "run.mcap", *choice, "-o", output, "--force", cwd=tmp_path)
        for choice in choices
    ]
    for process in running:
        _, err = process.communicate()
        assert (process.returncode, "Traceback" in err) == (0, False), err
    assert _without_time((tmp_path / output).read_text(), output) in alone
    assert not list(tmp_path.glob("*.part"))


def _without_time(text, name):
    """The text without what differs from run to run: the command line, and the time of it."""
    return "\n".join(line for line in text.splitlines() if name not in line)
