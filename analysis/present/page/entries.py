"""A matrix of coupling with its names and intervals, as pictures and tables show it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from undulog.capture.common.arrays import FloatArray

from ...results.coupling import Coupling, LocalCoupling, Matrix
from ...results.formats import decimals_for_values, number
from ...results.sweep import ComplexMatrix, LinearCoupling


@dataclass(frozen=True)
class Entries:
    """A matrix with its names.

    Attributes:
        symbol: E.g. ``P``.
        meaning: What an entry is, in words.
        rows: Names of the responding joints, m.
        columns: Names of the commanded joints, k.
        value: Shape (m, k); NaN where nothing is known.
        half: Half widths of the 95 % intervals, same shape; None where they are not known.
        row: What a row is.
        column: What a column is.
        verb: What the one does to the other.
        ends: Magnitude at the ends of the colours, where it is given by what stands beside it.
    """

    symbol: str
    meaning: str
    rows: tuple[str, ...]
    columns: tuple[str, ...]
    value: FloatArray
    half: FloatArray | None = None
    row: str = "the joint that responds"
    column: str = "the joint whose command is moved"
    verb: str = "follows"
    ends: float | None = None

    @property
    def limit(self) -> float:
        """Magnitude at the ends of the colours: the largest beside the diagonal, else of all."""
        if self.ends is not None:
            return self.ends
        size = np.nan_to_num(np.abs(self.value))
        beside = size[~np.eye(*size.shape, dtype=np.bool_)]
        largest = float(beside.max()) if beside.size else 0.0
        return largest or float(size.max()) or 1.0

    def told(self, i: int, j: int, decimals: int) -> str:
        """One entry in words.

        Args:
            i: Row.
            j: Column.
            decimals: Digits after the point.

        Returns:
            For example ``-0.21 ± 0.01``.
        """
        text = number(float(self.value[i, j]), decimals)
        if self.half is None or not np.isfinite(self.value[i, j]):
            return text
        return f"{text} \N{PLUS-MINUS SIGN} {number(float(self.half[i, j]), decimals)}"

    @property
    def cell_decimals(self) -> int:
        """Digits after the point that show two digits of the entries beside the diagonal."""
        return max(2, decimals_for_values([self.limit], 2))

    @property
    def decimals(self) -> int:
        """Digits after the point that show two digits of the typical interval, 2 to 6."""
        if self.half is None or not np.median(self.half) > 0:
            return 3
        return int(np.clip(1 - np.floor(np.log10(np.median(self.half))), 2, 6))

    def in_words(self) -> str:
        """What a reader who can't see the picture should know.

        Returns:
            Two sentences.
        """
        m, k = self.value.shape
        return (
            f"{m} rows: {self.row}; {k} columns: {self.column}. The colours end at "
            f"{self.limit:.3g}. The table below holds every number."
        )


def entries_of(coupling: Coupling, names: tuple[str, ...]) -> tuple[Entries, ...]:
    """The matrices that a coupling holds, the main one first.

    Args:
        coupling: Of a session or an experiment.
        names: Of the driven joints, where the coupling doesn't name them itself.

    Returns:
        None where it isn't identifiable; P, R, G and S of local kicks; of a sweep Z, where it is
        known, and H at its first tone, then the first of them at the others; else its one matrix.
    """
    if isinstance(coupling, LocalCoupling):
        known = (
            ("P", "phase of the response over phase of the command", coupling.P),
            ("R", "log amplitude of the response over phase of the command", coupling.R),
            ("G", "log amplitude of the response over log amplitude of the command", coupling.G),
            ("S", "phase of the response over log amplitude of the command", coupling.S),
        )
        return tuple(
            _local(symbol, meaning, matrix, coupling.joints)
            for symbol, meaning, matrix in known
            if matrix is not None
        )
    if isinstance(coupling, LinearCoupling):
        return _sweep(coupling)
    if coupling.matrix is None:
        return ()
    value = np.array(coupling.matrix, dtype=np.float64)
    rows = names if len(names) == len(value) else tuple(str(k + 1) for k in range(len(value)))
    return (Entries("Coupling", "response over command", rows, rows, value),)


def _local(symbol: str, meaning: str, matrix: Matrix, names: tuple[str, ...]) -> Entries:
    value, half = (np.array(one, dtype=np.float64) for one in (matrix.value, matrix.ci95_half))
    return Entries(symbol, meaning, names, names, value, half)


def _sweep(coupling: LinearCoupling) -> tuple[Entries, ...]:
    """What the answer speaks of comes first: Z, or H where Z isn't known."""
    several = len(coupling.tones) > 1
    found: list[Entries] = []
    for k, tone in enumerate(coupling.tones):
        at = f"{tone.frequency_hz:.4g} Hz"
        symbol = f" at {at}" if several and k else ""
        if tone.Z is not None:
            found += _parts(_torques(f"Z{symbol}", at, coupling.joints, tone.Z), tone.Z)
        if tone.Z is None or k == 0:
            found += _parts(_responses(f"H{symbol}", at, coupling.joints, tone.H), tone.H)
    return tuple(found)


def _torques(symbol: str, at: str, names: tuple[str, ...], matrix: ComplexMatrix) -> Entries:
    meaning = f"torque over angle at {at} [N m/rad]"
    who = ("the joint that feels the torque", "the joint that is moved", "feels")
    return Entries(symbol, meaning, names, names, *_real(matrix), *who)


def _responses(symbol: str, at: str, names: tuple[str, ...], matrix: ComplexMatrix) -> Entries:
    meaning = f"response over command at {at} [rad/rad]"
    return Entries(symbol, meaning, names, names, *_real(matrix))


def _real(matrix: ComplexMatrix) -> tuple[FloatArray, FloatArray]:
    return np.array(matrix.real, dtype=np.float64), np.array(matrix.ci95_half, dtype=np.float64)


def _parts(real: Entries, matrix: ComplexMatrix) -> tuple[Entries, Entries]:
    """Real and imaginary part, in the same colours: what is small beside the other looks small."""
    imag = replace(real, value=np.array(matrix.imag, dtype=np.float64))
    ends = max(real.limit, imag.limit)
    return (
        replace(real, symbol=f"Re {real.symbol}", ends=ends),
        replace(imag, symbol=f"Im {real.symbol}", ends=ends),
    )
