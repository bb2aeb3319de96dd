"""Faults of a table: bounded in number and length."""

from undulog.capture.common.strict_table import Faults, StrictTable


def test_of_very_many_faults_the_first_are_listed():
    faults = Faults()
    table = StrictTable({f"key{k}": k for k in range(100_000)}, "", faults)
    table.text("name")
    table.close()
    assert [fault.key for fault in faults.all()] == ["name", *(f"key{k}" for k in range(199))]


def test_long_keys_and_values_are_cut_in_messages():
    faults = Faults()
    table = StrictTable(
        {"number": "x" * 1_000_000, "y" * 1_000_000: 1, "words": [1] * 300}, "", faults
    )
    table.number("number")
    table.words("words")
    table.close()
    assert len(faults.all()) == 200
    assert all(len(str(fault)) < 5000 for fault in faults.all())
