"""Frequency responses at single frequencies and bins, with their noise, without a model.

**Sums of sines**, by least squares at their frequencies. Frequencies come from the command alone:
peaks of a spectrum whose side lobes are below -92 dB, made exact by Gauss-Newton steps of

    u(t) = sum_k Re(A_k exp(j w_k t)) + drift(t),                                        (1)

with a quadratic drift. The response is fitted with the same frequencies, and its noise at each of
them is the power of the residual in the nearest bins that no tone is in. Tones of other joints and
distortion are lines in some of these bins, the same in every period: they are no noise, so the
power is that of the median bin.

The lines of a periodic multisine are found by their power over the periods.

**The local polynomial method** leaves no leakage. Over a few neighbouring bins k + r of a record's
discrete Fourier transform the response G and the leakage T of a transient are smooth, so that

    Y(k + r) = sum_i G_i(k + r) U_i(k + r) + T(k + r) + V(k + r),    |r| <= n            (2)

with G_i and T polynomials of order R in r is a linear least-squares problem in (R + 1)(m + 1)
unknowns. Its solution at r = 0 is the response, and its residual the power of the noise V, of
which nonlinear distortion is a part where the excitation isn't periodic.

Source: Pintelon, Schoukens, Vandersteen & Barbe, Mechanical Systems and Signal Processing 24
(2010) 573-595, doi 10.1016/j.ymssp.2009.08.003.

**The indirect method.** In a closed loop, where commands u depend on the measured positions
y = G u + v, u and v are correlated, and a direct estimate of G is biased by S_vu / S_uu (cross and
power spectra). With an external reference r that does not depend on v

    G = G_yr / G_ur                                                                          (3)

of the responses of y and u to r has no such bias (Forssell & Ljung, Automatica 35, 1999, doi
10.1016/S0005-1098(99)00022-9; joint input-output: Pintelon & Schoukens, System Identification, 2nd
ed. 2012, 2.6.4). With the errors e of both, that of G is (e_y - G e_u) / G_ur to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len, prev_fast_len
from scipy.special import fdtri

from undulog.capture.common.arrays import BoolArray, ComplexArray, FloatArray, IntArray

from ...estimators.series import Series

LEAST_AMPLITUDE = 0.01
"""Of the largest tone's; smaller ones are left in the residual."""

MOST_TONES = 64

EXCITED_SHARE = 1e-3
"""A line is excited if it has more than this share of the strongest line's power."""

EXPLAINED = 0.999
"""Share of the command's variance that the tones of a sum of sines explain."""

SEPARATION = 4.0
"""Least distance of two tones, in bins of the record: half the main lobe of the window."""

NOISE_BINS = 12
_MOST_CELLS = 1 << 22  # samples times tones: beyond it the fit would fill the memory
_DRIFT = 2  # order of the polynomial
_STEPS = 4
_A = 0.35875, 0.48829, 0.14128, 0.01168  # of the Blackman-Harris window
_WINDOW = _A[0] - _A[2], 3 * _A[3] - _A[1], 2 * _A[2], -4 * _A[3]  # the same by powers of cos
_SHIFT = 1.5  # bins from a tone to the first bin of noise

ORDER = 2
"""Of the polynomials: the lowest that follows a curved response and an odd transient alike."""

LEAST_FREEDOM = 6
"""Complex residuals at least left over: their power is known to 40 %."""

_SMALLEST_PIVOT = 1e-6
"""Relative; below it the inputs of a window can't be separated."""

CLEAR = 2.0
"""Equation (3) is first order: the command's response to the reference is so many times the radius
of its 95 % disc, or the line is left out."""


def _float(values: object) -> FloatArray:
    return np.asarray(values, dtype=np.float64)


def _radius(variance: FloatArray, freedom: FloatArray | int, level: float) -> FloatArray:
    """|e|^2 / variance is distributed as F with 2 and 2 q degrees of freedom."""
    return _float(np.sqrt(variance * fdtri(2, 2 * freedom, level)))


@dataclass(frozen=True)
class LineResponse:
    """Responses at k frequencies.

    Attributes:
        frequency_hz: Shape (k,).
        value: Output over input, shape (k,).
        variance: E|e|^2 of the error e of ``value``, shape (k,); circular.
        freedom: Complex degrees of freedom of ``variance``, shape (k,).
    """

    frequency_hz: FloatArray
    value: ComplexArray
    variance: FloatArray
    freedom: FloatArray

    def radius(self, level: float = 0.95) -> FloatArray:
        """Return the radius of the disc that holds each response, shape (k,)."""
        return _radius(self.variance, self.freedom, level)


def resampled(series: Series, t_s: FloatArray) -> FloatArray:
    """Return a series at other times, by cubic splines.

    Args:
        t_s: Times [s], shape (n,).
    """
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(series.t_s, series.values)(t_s), dtype=np.float64)


def even_times(start: float, stop: float, step: float) -> tuple[FloatArray, float]:
    """Return even times over a stretch, whose fast Fourier transforms take little time.

    A number of samples with a large prime factor takes ten times as long. Cutting the stretch
    instead would add leakage to a command that begins and ends at rest.

    Args:
        step: Longest distance [s].

    Returns:
        Times [s] from ``start`` on, shape (n,), n even; their distance [s], the stretch's length
        over n.
    """
    count = 2 * next_fast_len(math.ceil((stop - start) / step / 2))
    distance = (stop - start) / count
    return _float(start + distance * np.arange(count)), distance


def find_tones(command: Series, even: FloatArray) -> FloatArray | None:
    """Return the frequencies of a sum of sines [Hz], or None if the command is none.

    Args:
        command: At least 32 samples.
        even: The same at even steps of its sampling interval.
    """
    even = even[: prev_fast_len(even.size)]
    place = np.linspace(-1.0, 1.0, even.size)
    values = even - even.mean()
    values -= place * (place @ values) / (place @ place)
    if not values.any():
        return None
    spectrum = np.abs(np.fft.rfft(values * _blackman_harris(values.size)))
    inner = spectrum[1:-1]
    high = (inner > spectrum[:-2]) & (inner > spectrum[2:])
    peaks = 1 + np.flatnonzero(high & (inner >= LEAST_AMPLITUDE * spectrum.max()))
    peaks = peaks[peaks >= SEPARATION]  # below it is the drift
    if peaks.size * values.size > _MOST_CELLS:
        return None
    if not 0 < peaks.size <= MOST_TONES or (np.diff(peaks) < SEPARATION).any():
        return None
    tones_hz = peaks / (even.size * command.period_s)
    for _ in range(_STEPS):
        tones_hz = tones_hz + _step(command, tones_hz)
    residual = command.values - _fitted(command, tones_hz)
    left = np.var(residual) / np.var(command.values)
    return tones_hz if left <= 1 - EXPLAINED else None


def _blackman_harris(count: int) -> FloatArray:
    """Return the four-term window with side lobes below -92 dB (Harris, Proc. IEEE 66, 1978).

    SciPy's takes three times as long, and a quarter of a second to import.
    """
    x = np.cos(np.linspace(0.0, 2 * np.pi, count))
    # cos 2a = 2 cos^2 a - 1 and cos 3a = 4 cos^3 a - 3 cos a in the sum of cosines.
    return _float(np.polynomial.polynomial.polyval(x, _WINDOW))


def tone_response(
    command: Series, response: Series, tones_hz: FloatArray, *, looped: bool = False
) -> LineResponse:
    """Estimate the response at some tones.

    Args:
        command: Its samples.
        response: Samples of the same stretch, at times of their own.
        tones_hz: From :func:`find_tones`.
        looped: Whether the tones are those of an external reference, and the command contains
            noise that a loop feeds back: the noise is that of y - G u then.
    """
    inputs, outputs = _amplitudes(command, tones_hz), _amplitudes(response, tones_hz)
    value = outputs / inputs
    used = (response, command) if looped else (response,)
    left = [series.values - _fitted(series, tones_hz) for series in used]
    length_s = response.t_s[-1] - response.t_s[0]
    noise, freedom = np.empty(tones_hz.size), np.empty(tones_hz.size)
    for k, tone in enumerate(tones_hz):
        bins = _bins_beside(tone, tones_hz, length_s, 0.5 / response.period_s)
        rest = _rest(response, left[0], bins)
        if looped:
            rest = rest - value[k] * _rest(command, left[1], bins)
        noise[k] = _level(np.abs(rest) ** 2)
        freedom[k] = bins.size * np.log(2) ** 2
    return LineResponse(tones_hz, value, noise / np.abs(inputs) ** 2, freedom)


def _rest(series: Series, left: FloatArray, at_hz: FloatArray) -> ComplexArray:
    """Return the complex amplitudes of what the tones leave, at other frequencies."""
    turns = np.exp(-2j * np.pi * np.outer(at_hz, series.t_s))
    return np.asarray(2.0 / series.count * (turns @ left), dtype=np.complex128)


def _level(power: FloatArray) -> float:
    """Return the noise level of bins by their median, which lines in less than half of them leave.

    Powers of n bins of noise are exponential variables; the k-th smallest has the mean
    1/n + ... + 1/(n - k + 1). The median has log(2)^2 of the mean's degrees of freedom.
    """
    n = power.size
    means = np.cumsum(1.0 / np.arange(n, 0, -1.0))
    return float(np.median(power) / np.median(means))


def _bins_beside(tone: float, tones_hz: FloatArray, length_s: float, highest: float) -> FloatArray:
    """Return the frequencies next to a tone that are at least a bin and a half from any [Hz]."""
    reach = np.arange(4 * NOISE_BINS) + _SHIFT
    beside = _float(np.concatenate([tone - reach / length_s, tone + reach / length_s]))
    beside = beside[(beside > _SHIFT / length_s) & (beside < highest)]
    distance = np.abs(beside[:, None] - tones_hz).min(axis=1)
    beside = beside[distance >= 0.999 * _SHIFT / length_s]
    return beside[np.argsort(np.abs(beside - tone))[:NOISE_BINS]]


def _design(t_s: FloatArray, tones_hz: FloatArray) -> FloatArray:
    span = (t_s[-1] - t_s[0]) / 2
    drift = ((t_s - t_s[0]) / span - 1)[:, None] ** np.arange(_DRIFT + 1)
    angle = 2 * np.pi * np.outer(t_s, tones_hz)
    return np.hstack([drift, np.cos(angle), np.sin(angle)])


def _solve(series: Series, design: FloatArray) -> FloatArray:
    return _float(np.linalg.lstsq(design, series.values, rcond=None)[0])


def _amplitudes(series: Series, tones_hz: FloatArray) -> ComplexArray:
    """Return A_k of equation (1), shape (k,)."""
    coefficients = _solve(series, _design(series.t_s, tones_hz))[_DRIFT + 1 :]
    return coefficients[: tones_hz.size] - 1j * coefficients[tones_hz.size :]


def _fitted(series: Series, tones_hz: FloatArray) -> FloatArray:
    design = _design(series.t_s, tones_hz)
    return design @ _solve(series, design)


def _step(series: Series, tones_hz: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step of the frequencies [Hz]."""
    middle_s = (series.t_s[0] + series.t_s[-1]) / 2
    moved = 2 * np.pi * (series.t_s - middle_s)[:, None]
    angle = 2 * np.pi * np.outer(series.t_s, tones_hz)
    amplitude = _amplitudes(series, tones_hz)
    # d/df of Re(A exp(j w t)), at a fixed phase in the middle of the record.
    slope = -moved * (amplitude.real * np.sin(angle) + amplitude.imag * np.cos(angle))
    design = np.hstack([_design(series.t_s, tones_hz), slope])
    return _solve(series, design)[-tones_hz.size :]


def excited_lines(spectra: ComplexArray) -> IntArray:
    """Return the lines that a multisine excites.

    Args:
        spectra: Of one period of each realisation, from line 0 on, shape (M, n).
    """
    power = np.mean(np.abs(spectra) ** 2, axis=0)
    power[0] = 0.0
    return np.flatnonzero(power > EXCITED_SHARE * power.max())


def noise_power(spectra: ComplexArray) -> FloatArray:
    """Return E|e|^2 of the mean over the periods, by their scatter.

    Args:
        spectra: Of each of P periods, shape (..., P, n).

    Returns:
        Shape (..., n); NaN from one period.
    """
    periods = spectra.shape[-2]
    if periods < 2:
        return np.full((*spectra.shape[:-2], spectra.shape[-1]), np.nan)
    mean = spectra.mean(axis=-2, keepdims=True)
    return np.sum(np.abs(spectra - mean) ** 2, axis=-2) / (periods - 1) / periods


def line_power(spectra: ComplexArray) -> FloatArray:
    """Return the power of each line without that of the noise, which may leave less than zero.

    Args:
        spectra: Of each of P periods, shape (..., P, n), P at least 2.

    Returns:
        Shape (..., n).
    """
    return np.abs(spectra.mean(axis=-2)) ** 2 - noise_power(spectra)


@dataclass(frozen=True)
class LocalResponse:
    """Responses at c bins from m inputs to one output.

    Attributes:
        bins: The bins, shape (c,).
        value: G, output over input, shape (c, m); NaN where the inputs can't be separated.
        covariance: E[e e^H] of the error e of ``value``, shape (c, m, m); circular.
        noise: E|V|^2 at the output, in the DFT's scale, shape (c,).
        freedom: Complex degrees of freedom of ``noise``.
    """

    bins: IntArray
    value: ComplexArray
    covariance: ComplexArray
    noise: FloatArray
    freedom: int

    @property
    def variance(self) -> FloatArray:
        """E|e|^2 of each response, shape (c, m)."""
        return np.einsum("cmm->cm", self.covariance).real

    def radius(self, level: float = 0.95) -> FloatArray:
        """Return the radius of the disc that holds each response, shape (c, m)."""
        return _radius(self.variance, self.freedom, level)


def window(inputs: int, order: int = ORDER, freedom: int = LEAST_FREEDOM) -> int:
    """Return the least half width n of the window that leaves so many degrees of freedom."""
    return (freedom + (order + 1) * (inputs + 1)) // 2


def local_response(
    output: ComplexArray,
    inputs: ComplexArray,
    bins: IntArray,
    half: int,
    *,
    order: int = ORDER,
) -> LocalResponse:
    """Fit equation (2) around each of some bins.

    Args:
        output: Spectrum Y from bin 0 on, shape (n,).
        inputs: Spectra U, shape (m, n).
        bins: Centres k, shape (c,). Near the ends the window is moved inwards.
        half: Half width n of the window.

    Returns:
        The responses.

    Raises:
        ValueError: If the window leaves no degree of freedom or the spectrum is shorter.
    """
    m, length = inputs.shape
    width, unknowns = 2 * half + 1, (order + 1) * (m + 1)
    if width <= unknowns or length <= width:
        raise ValueError(f"a window of {width} bins of {length} for {unknowns} unknowns")
    first = np.clip(bins - half, 1, length - width)
    index = first[:, None] + np.arange(width)  # (c, w)
    powers = ((index - bins[:, None]) / half)[:, :, None] ** np.arange(order + 1)  # (c, w, R+1)
    local = inputs[:, index]  # (m, c, w)
    scale = np.sqrt(np.mean(np.abs(local) ** 2, axis=2)) + np.finfo(float).tiny  # (m, c)
    columns = [local[i, :, :, None] / scale[i, :, None, None] * powers for i in range(m)]
    design = np.concatenate([*columns, powers.astype(np.complex128)], axis=2)
    q, r = np.linalg.qr(design)
    pivots = np.abs(np.einsum("cii->ci", r))
    sound = pivots.min(axis=1) > _SMALLEST_PIVOT * pivots.max(axis=1)
    r[~sound] = np.eye(unknowns)
    data = output[index]
    projected = np.einsum("cwp,cw->cp", q.conj(), data)
    residual = data - np.einsum("cwp,cp->cw", q, projected)
    freedom = width - unknowns
    noise = np.sum(np.abs(residual) ** 2, axis=1) / freedom
    inverse = np.asarray(np.linalg.inv(r), dtype=np.complex128)
    solution: ComplexArray = np.einsum("cpq,cq->cp", inverse, projected)
    at: IntArray = np.arange(m, dtype=np.int64) * (order + 1)  # the constants of the G_i
    rows = inverse[:, at, :] / scale.T[:, :, None]
    value: ComplexArray = solution[:, at] / scale.T
    value[~sound] = np.nan
    covariance = noise[:, None, None] * (rows @ rows.conj().transpose(0, 2, 1))
    return LocalResponse(bins, value, covariance, noise, freedom)


def indirect_response(
    output: ComplexArray,
    command: ComplexArray,
    reference: ComplexArray,
    bins: IntArray,
    half: int,
) -> tuple[ComplexArray, FloatArray, int]:
    """Estimate G of equation (3) with the local polynomial method.

    Args:
        output: Spectrum of y, shape (n,).
        command: Spectrum of u, shape (n,).
        reference: Spectrum of r, shape (n,).
        bins: Centres, shape (c,).
        half: Half width of the windows.

    Returns:
        G, shape (c,); E|e|^2 of its error, NaN where the reference hardly moves the command, shape
        (c,); complex degrees of freedom of that.
    """
    # Variances are quadratic forms of the output: those of sums give the covariance of e_y and e_u.
    y, u, in_phase, turned = (
        local_response(values, reference[None], bins, half)
        for values in (output, command, output + command, output + 1j * command)
    )
    power_y, power_u = y.variance[:, 0], u.variance[:, 0]
    real = (in_phase.variance[:, 0] - power_y - power_u) / 2
    imaginary = (turned.variance[:, 0] - power_y - power_u) / 2
    driven = u.value[:, 0]
    clear: BoolArray = np.abs(driven) > CLEAR * u.radius()[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        value: ComplexArray = np.asarray(y.value[:, 0] / driven, dtype=np.complex128)
        shared = 2 * np.real(np.conj(value) * (real + 1j * imaginary))
        variance = (power_y + np.abs(value) ** 2 * power_u - shared) / np.abs(driven) ** 2
    return value, np.where(clear, np.maximum(variance, 0.0), np.nan), y.freedom
