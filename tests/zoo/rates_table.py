"""The table of the rates: a line for each kind and each fault, with its bar."""

from collections.abc import Iterable, Sequence

from scipy.stats import binom

ACCUSED = 0.01
"""Share of healthy sessions in which a joint may be accused."""

DIFFERENT = 0.05
"""Share of sessions of like joints in which some may be stated to differ, and of unlike ones that
may be stated to be alike: the level of the intervals and of the equivalence tests."""

RIGHT = 0.95
"""Share of planted faults that are to be right: one of three half-widths of a 95 % interval is
missed hardly ever, and the level of a statement of difference is what is left to be wrong."""

ONSET = 0.90
"""Share of the faults that are right and begin within the record whose onset is to be right."""

HALVES = 3.0
"""Size of a planted fault in half-widths from which it has a bar."""

CONFIDENCE = 0.99
"""Of the binomial limits: a count beyond them is no chance."""


def most(share: float, sessions: int) -> int:
    """Return the largest count that a share allows: 31 of 2,000 at 1 %."""
    return int(binom.ppf(CONFIDENCE, sessions, share))


def least(share: float, sessions: int) -> int:
    """Return the least count that a share allows."""
    return sessions - most(1 - share, sessions)


def table(rows: Sequence[dict]) -> tuple[list[str], bool]:
    """Return the table's lines, and whether every bar is met.

    Args:
        rows: Of ``rows.jsonl``.
    """
    healthy = [row for row in rows if row["fault"] == "healthy"]
    recorded = [row for row in rows if row["fault"] == "recorded"]
    others = [row for row in rows if row["fault"] not in ("healthy", "recorded")]
    in_recordings = [row for row in others if "/" in row["kind"] or row["kind"] == "kuka"]
    drawn = [row for row in others if row not in in_recordings] if in_recordings else others
    lines: list[str] = []
    met = True
    for part, head, line in (
        (healthy, HEALTHY_HEAD, _healthy_line),
        (drawn, FAULT_HEAD, _fault_line),
        (in_recordings, FAULT_HEAD, _fault_line),
    ):
        if part:
            key = "kind" if part is healthy else "fault"
            title = "in recordings of real robots" if part is in_recordings else ""
            lines += [*([title] if title else []), head]
            for name, group in _grouped(part, key):
                text, is_met = line(name, group)
                lines.append(text)
                met &= is_met
            lines.append("")
    if recorded:
        lines += [*_recorded_lines(recorded), ""]
    return lines, met


def _grouped(rows: Iterable[dict], key: str) -> list[tuple[str, list[dict]]]:
    """Return rows by a key in order of appearance, and behind them all of them."""
    groups: dict[str, list[dict]] = {}
    for row in rows:
        groups.setdefault(row[key], []).append(row)
    every_row = [row for group in groups.values() for row in group]
    return [*groups.items(), ("all", every_row)]


HEALTHY_HEAD = (
    f"{'healthy kind':<18} sessions  accused (at most)  different (at most)  "
    "called alike, unlike  errors"
)


def _healthy_line(name: str, rows: list[dict]) -> tuple[str, bool]:
    sessions = len(rows)
    like = [row for row in rows if not row.get("differs")]
    accused = sum(bool(row.get("accusations")) for row in rows)
    different = sum(bool(row.get("differences") or row.get("shaped")) for row in like)
    unlike = [row for row in rows if row.get("unlike")]
    alike = sum(bool(row.get("alike")) for row in unlike)
    errors = sum("error" in row for row in rows)
    limits = most(ACCUSED, sessions), most(DIFFERENT, len(like))
    wrong_alike = alike > most(DIFFERENT, len(unlike))
    is_met = accused <= limits[0] and different <= limits[1] and not wrong_alike and not errors
    text = f"{name:<18} {sessions:>8}  {accused:>7} {f'({limits[0]})':>9}  "
    text += f"{different:>9} {f'({limits[1]})':>9}  {alike:>20}  {errors:>6}"
    return f"{text}{_mark(is_met)}", is_met


FAULT_HEAD = (
    f"{'fault':<18} sessions  right (at least)  joint  kind  onset (of, at least)  accuse another  "
    "alike  silent  not planted"
)


def _fault_line(name: str, rows: list[dict]) -> tuple[str, bool]:
    seen = [row for row in rows if row["seen"]]
    sessions = len(seen)

    def count(key: str) -> int:
        return sum(bool(row.get(key)) for row in seen)

    # Smaller faults than the bar speaks of are a curve.
    has_bar = min((row["halves"] for row in seen), default=0.0) >= HALVES
    right, limit = count("right"), least(RIGHT, sessions) if has_bar else 0
    begun = [row for row in seen if row.get("right") and row.get("since_s") is not None]
    onset = sum(bool(row.get("onset")) for row in begun)
    onsets = least(ONSET, len(begun)) if has_bar else 0
    is_met = right >= limit and onset >= onsets
    text = f"{name:<18} {sessions:>8}  {right:>5} {f'({limit})':>10}  {count('joint'):>5} "
    text += f"{count('kind_right'):>5}  {onset:>5} {f'({len(begun)}, {onsets})':>14}  "
    text += f"{count('accusations'):>14}  "
    text += f"{count('alike'):>5}  {count('silent'):>6}  {len(rows) - sessions:>11}"
    return f"{text}{_mark(is_met)}", is_met


def _recorded_lines(rows: list[dict]) -> list[str]:
    """Return what is said of the recordings as they are."""
    lines = [f"{'recording':<30} accused, of which refuted by the independent fit"]
    for row in rows:
        refuted = row.get("refuted", [])
        names = [f"{name}{' (refuted)' if name in refuted else ''}" for name in row["accusations"]]
        lines.append(f"{row['kind']:<30} {', '.join(names) or 'none'}")
    accused = sum(len(row["accusations"]) for row in rows)
    refuted = sum(len(row.get("refuted", [])) for row in rows)
    return [*lines, f"{'all':<30} {accused} accusations, {refuted} refuted"]


def _mark(is_met: bool) -> str:
    return "" if is_met else "  FAILS"
