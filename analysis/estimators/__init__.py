"""Estimators on plain arrays: harmonic fits, demodulation, spectra, ratios of noisy matrices."""
