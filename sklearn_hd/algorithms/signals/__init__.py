"""Signals in time: Fourier coefficients, resampling, periods side by side."""
