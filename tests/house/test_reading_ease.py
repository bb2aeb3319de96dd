"""The check of prose finds what it is for, and passes what isn't prose."""

import pytest

from house import reading_ease


@pytest.fixture(scope="module")
def spelling():
    return reading_ease.dictionary()


LONG = " ".join(["word"] * 31)


@pytest.mark.parametrize(
    ("page", "fault"),
    [
        (f"{LONG.capitalize()}.", "31 words"),
        ("The log tells what happened.", "standard term, report"),
        ("An amplitde.", "'amplitde' is in no dictionary"),
        ("* One [amplitde](amplitude.md) in a link.", "'amplitde'"),
    ],
)
def test_a_fault_is_named(page, fault, spelling):
    (complaint,) = reading_ease.faults(page, spelling)
    assert fault in complaint


@pytest.mark.parametrize(
    "page",
    [
        f"```console\n$ undulog {LONG}\n```\n",
        f"| {LONG} | xyzzy |",
        f"Code `{LONG} amplitde`, a link [here](xyzzy.md).",
        "Two sentences. W" + " ".join(["ord", *["word"] * 29]) + ". Another.",
        "- an item\n- " + " ".join(["word"] * 30),
        "undulog analyses MCAP files of ROS 2, the robot's too.",
    ],
)
def test_what_is_in_order_passes(page, spelling):
    assert list(reading_ease.faults(page, spelling)) == []


def test_the_words_of_the_project_are_sorted_and_needed():
    lines = reading_ease.WORDS.read_text().splitlines()
    assert lines == sorted(set(lines), key=str.lower)
    english = reading_ease.SpellChecker()
    assert [word for word in lines if word.lower() in english] == []
