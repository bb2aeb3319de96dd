"""Check how README and tutorials read: sentences, standard terms, spelling; ``make check``.

A sentence has at most 30 words; code, tables and addresses of links are not counted. Words that
have a standard term are named with it. Spelling is that of pyspellchecker's English dictionary and
of ``docs/words.txt``, the project's reviewed list: a line a word.
"""

import re
import sys
from collections.abc import Iterator
from pathlib import Path

from spellchecker import SpellChecker

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "docs/index.md", *sorted(ROOT.glob("docs/tutorials/*.md")))
WORDS = ROOT / "docs/words.txt"
MOST_WORDS = 30

STANDARD = {
    "tell, tells, told": "report, show",
    "say, says, said": "report, state",
    "hear, hears, heard": "receive",
    "heed, heeds": "observe",
    "knows": "has",
    "asks": "requests",
    "glimpse": "preview",
    "foresight, foreseen": "prediction, predicted",
    "sameness": "difference",
    "astray": "off-frequency",
    "ballast": "reserved disk space",
    "lookout": "obstacle monitor",
    "reckoning": "dead reckoning",
    "haste, hastens": "speed-up",
    "mend, mends": "fix",
    "teller": "publisher",
}
"""Words that don't stand in prose, and what does."""

_NO_PROSE = re.compile(
    r"^(`{3,})[\s\S]*?^\1$|^\|.*$|^#+ .*$|^!\[.*?\]\([^)]*\)|<[^>]+>", re.MULTILINE
)
_LINK = re.compile(r"\[([^]]*)\]\([^)]*\)")
_CODE = re.compile(r"`[^`]+`")
_ITEM = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*]|\d+\.) )")
_END = re.compile(r"(?<=[.!?])[)*]*\s+(?=[^a-z]|undulog)")
_WORD = re.compile(r"[^\W\d_]+(?:['’][a-z]+)?")


def sentences(page: str) -> Iterator[str]:
    """Return the sentences of a page's prose, code in it as ``·``."""
    prose = _CODE.sub("·", _LINK.sub(r"\1", _NO_PROSE.sub("", page)))
    for paragraph in _ITEM.split(prose):
        for sentence in _END.split(" ".join(paragraph.split())):
            if _WORD.search(sentence):
                yield sentence


def words(sentence: str) -> list[str]:
    """Return the words of a sentence."""
    return _WORD.findall(sentence)


def faults(page: str, spelling: SpellChecker) -> Iterator[str]:
    """Return what a page's prose has against these rules, a line each."""
    standard = {word: term for some, term in STANDARD.items() for word in some.split(", ")}
    for sentence in sentences(page):
        words_of = words(sentence)
        if len(words_of) > MOST_WORDS:
            yield f"{len(words_of)} words, {MOST_WORDS} at most: {sentence}"
        for word in words_of:
            plain = word.lower().replace("’", "'").removesuffix("'s")
            if plain in standard:
                yield f"{word!r} has a standard term, {standard[plain]}: {sentence}"
            elif len(plain) > 2 and plain not in spelling and "'" not in plain:
                yield f"{word!r} is in no dictionary, nor in {WORDS.name}: {sentence}"


def dictionary() -> SpellChecker:
    """Return the words that are spelt right, the project's own among them."""
    checker = SpellChecker()
    checker.word_frequency.load_words(WORDS.read_text().split())
    return checker


def main() -> int:
    """Print the faults of all pages; return the exit code."""
    spelling = dictionary()
    lines = [
        f"{page.relative_to(ROOT)}: {fault}"
        for page in PAGES
        for fault in faults(page.read_text(), spelling)
    ]
    print("\n".join(lines) or f"{len(PAGES)} pages read well.")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
