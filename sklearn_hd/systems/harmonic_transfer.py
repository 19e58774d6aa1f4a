"""Harmonic transfer functions of models and of records, in one labelled form."""

import numbers
import reprlib
import warnings
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from scipy.signal import get_window
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._checks import (
    check_count,
    check_fraction,
    check_frequencies,
    check_period,
    check_positive,
    check_same_rows,
    check_time_origin,
    check_values,
    signal_names,
)
from sklearn_hd._clock import read_time
from sklearn_hd._containers import as_container, to_float, warn_if_counted
from sklearn_hd._guards import warn, within_range
from sklearn_hd.algorithms.periodic.harmonic_transfer import (
    effective_averages,
    estimate_harmonic_transfer,
    harmonic_transfer,
    held_harmonic_transfer,
    segment_plan,
)
from sklearn_hd.algorithms.signals.fourier import times_near_zero_phase


@dataclass(frozen=True, eq=False)
class HarmonicTransferFunction:
    """Frequency response H_n(jΩ) of a linear time-periodic system.

        u(t) = u e^{jΩt}   →   y(t) = Σ_n H_n(jΩ) u e^{j(Ω + nω)t}

    Made by :meth:`LTPSystem.harmonic_transfer_function` and
    :func:`estimate_harmonic_transfer_function`; each parameter is an attribute.

    Parameters
    ----------
    omega : float
        Fundamental frequency, rad/s.
    frequencies : ndarray, shape (n_frequencies,)
        Ω of the input, in rad/s.
    response : complex ndarray, shape (n_frequencies, 2 N + 1, n_outputs, n_inputs)
        H_n(jΩ), n from −N to N. H_n(−jΩ) is the conjugate of H_−n(jΩ).
    input_names, output_names : tuple of str
        In the order of the response's last axes.
    std : ndarray, shape of ``response``
        For estimates: standard deviation √E|Ĥ − H|². None for models.
    coherence : ndarray, shape (n_frequencies, 2 N + 1, n_outputs)
        For estimates: share of the output's power at Ω + nω that all harmonics of the inputs
        explain together. None for models.
    n_averages : float
        For estimates: number of independent segments averaged. None for models.

    References
    ----------
    N. M. Wereley, S. R. Hall, "Frequency response of linear time periodic
    systems", 29th IEEE Conference on Decision and Control (1990).

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> response = mathieu().harmonic_transfer_function([0.5, 1.0], 1)
    >>> response.n_harmonics, response.response.shape
    (1, (2, 3, 2, 1))
    >>> response.to_frame().columns.names
    FrozenList(['output', 'input', 'harmonic'])
    """

    omega: float
    frequencies: np.ndarray = field(repr=False)
    response: np.ndarray = field(repr=False)
    input_names: tuple
    output_names: tuple
    std: np.ndarray | None = field(default=None, repr=False)
    coherence: np.ndarray | None = field(default=None, repr=False)
    n_averages: float | None = None

    @property
    def n_harmonics(self):
        """N, the highest harmonic."""
        return self.response.shape[1] // 2

    def harmonic(self, n):
        """H_n(jΩ) of one harmonic.

        Parameters
        ----------
        n : int
            From −N to N.

        Returns
        -------
        response : complex ndarray, shape (n_frequencies, n_outputs, n_inputs)
            From the input at Ω to the output at Ω + nω.

        Raises
        ------
        ValueError
            If n is not whole, or beyond N.
        """
        whole = isinstance(n, numbers.Integral) and not isinstance(n, bool)
        if not whole or abs(n) > self.n_harmonics:
            way = f"ask for n_harmonics={abs(n)} or more" if whole else "give a whole number"
            raise ValueError(
                f"harmonic {n!r} is not among −{self.n_harmonics} … {self.n_harmonics}; {way}"
            )
        return self.response[:, self.n_harmonics + n]

    def to_frame(self, what="response"):
        """The response, or its standard deviation, as a table.

        Parameters
        ----------
        what : {"response", "std"}, default="response"
            Models have no ``"std"``.

        Returns
        -------
        table : DataFrame
            Index: frequency in rad/s; columns: (output, input, harmonic).

        Raises
        ------
        ValueError
            If ``what`` is not available.
        """
        if what not in ("response", "std") or getattr(self, what) is None:
            raise ValueError(f"what={what!r} is not known; use 'response', or 'std' of an estimate")
        columns = pd.MultiIndex.from_product(
            [self.output_names, self.input_names, self._harmonics()],
            names=["output", "input", "harmonic"],
        )
        flat = getattr(self, what).transpose(0, 2, 3, 1).reshape(len(self.frequencies), -1)
        return pd.DataFrame(flat, pd.Index(self.frequencies, name="frequency"), columns)

    def misfit(self, model):
        """Distance of a model from this estimate, in standard deviations.

            √(mean_Ω (|Ĥ_n − H_n|² / std²))

        Near 1, the two agree within the noise; an error of the model gives more.

        Parameters
        ----------
        model : HarmonicTransferFunction
            At the same frequencies, of the same signals, with as many harmonics or more.

        Returns
        -------
        misfit : DataFrame, n_outputs · n_inputs rows by 2 N + 1 harmonics
            In standard deviations; NaN where nothing was excited.

        Raises
        ------
        ValueError
            If this is not an estimate, or the model differs in signals, harmonics or
            frequencies.
        """
        if self.std is None:
            raise ValueError("a misfit needs standard deviations; call misfit on the estimate")
        if not isinstance(model, HarmonicTransferFunction):
            raise ValueError(
                f"model={reprlib.repr(model)} is not a HarmonicTransferFunction; give the result "
                f"of LTPSystem.harmonic_transfer_function"
            )
        same = (self.input_names, self.output_names) == (model.input_names, model.output_names)
        extra = model.n_harmonics - self.n_harmonics
        if not same or extra < 0 or not np.array_equal(self.frequencies, model.frequencies):
            raise ValueError(
                "estimate and model differ in signals, harmonics or frequencies; compute the "
                "model's at estimate.frequencies, with estimate.n_harmonics"
            )
        others = model.response[:, extra : extra + 2 * self.n_harmonics + 1]
        deviation = np.abs(self.response - others) / self.std
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # nowhere excited: NaN
            rms = np.sqrt(np.nanmean(deviation**2, axis=0))
        index = pd.MultiIndex.from_product(
            [self.output_names, self.input_names], names=["output", "input"]
        )
        columns = pd.Index(self._harmonics(), name="harmonic")
        return pd.DataFrame(rms.transpose(1, 2, 0).reshape(len(index), -1), index, columns)

    def _harmonics(self):
        return range(-self.n_harmonics, self.n_harmonics + 1)


def model_response(system, frequencies, N, sample_time, tolerance, max_internal_harmonics):
    """Harmonic transfer function of an LTPSystem."""
    frequencies = check_frequencies(frequencies)
    if sample_time is None:
        response = _continuous(system, frequencies, N, tolerance, max_internal_harmonics)
    else:
        response = _held(system, frequencies, N, sample_time)
    names = system.input_names, system.output_names
    return HarmonicTransferFunction(system.omega, frequencies, response, *names)


def _continuous(system, frequencies, N, tolerance, max_harmonics):
    hint = f"it must exceed n_harmonics={N} by enough to converge"
    check_count("max_internal_harmonics", max_harmonics, N + 1, hint)
    response, change = harmonic_transfer(
        system.fourier_coefficients, system.omega, frequencies, N, tolerance, max_harmonics
    )
    if change > tolerance:
        warn(
            f"the harmonic transfer function still changes by {change:.2g} of its largest value at "
            f"the {max_harmonics} internal harmonics allowed (tolerance {tolerance:g}), because F, "
            f"G, P or Q has kinks or jumps; raise max_internal_harmonics, or give sample_time, "
            f"which needs no truncation",
            ConvergenceWarning,
        )
    return response


def _held(system, frequencies, N, sample_time):
    hint = "it is the time for which inputs are held"
    dt = check_positive("sample_time", sample_time, "seconds", hint)
    S = check_period(system.omega, dt, N)
    psi = 2.0 * np.pi * np.arange(S + 1) / S
    Phi, Gamma = system._transition_matrices(psi)
    P, Q = system.P(psi[:-1]), system.Q(psi[:-1])
    return held_harmonic_transfer(Phi, Gamma, P, Q, frequencies, dt, N)


@within_range
def estimate_harmonic_transfer_function(
    u,
    y,
    omega,
    n_harmonics,
    *,
    periods_per_segment=None,
    window="hann",
    overlap=0.5,
    sample_time=None,
    time_origin=None,
):
    """Estimate the harmonic transfer function from a record, without a model.

    The record is cut into overlapping, windowed segments. At each frequency, least squares over
    the segments separates the shares of the output that come from different input harmonics, Y(Ω)
    = Σ_n H_n(j(Ω − nω)) U(Ω − nω). All inputs must therefore move at all these frequencies in ways
    that vary from segment to segment, as noise, random steps and multisines with changing phases
    do. Subtract the trim first: a periodic waveform in y spoils the frequencies near multiples of
    ω.

    Parameters
    ----------
    u, y : DataFrame, Series or ndarray, shapes (n_samples, n_inputs or n_outputs)
        Inputs and outputs with the same rows. The index is the time, ψ = ωt, in
        seconds; a (record, time) MultiIndex holds several records. Gaps start a new
        segment.
    omega : float
        Fundamental frequency, rad/s.
    n_harmonics : int
        N: harmonics −N … N of the response are estimated separately; higher ones count as noise.
    periods_per_segment : int, optional
        Length of a segment in periods of ω. It should last ten time constants of the slowest mode
        or more: leakage at resonances narrower than ω / periods is a bias that ``std`` does not
        include. By default the longest segment that leaves ten independent segments for each of
        the (2N + 1) m unknowns.
    window : str or tuple, default="hann"
        As for :func:`scipy.signal.get_window`.
    overlap : float, default=0.5
        Share of a segment that the next one repeats, from 0 to below 1.
    sample_time : float, optional
        Seconds from row to row of arrays, which start at ψ = 0.
    time_origin : str, optional
        The instant of ψ = 0, if the index holds dates.

    Returns
    -------
    estimate : HarmonicTransferFunction
        With ``std``, ``coherence`` and ``n_averages``; at frequencies from 0 to half
        the sampling frequency less Nω.

    Raises
    ------
    ValueError
        If the records are too short for these harmonics, or unevenly sampled.

    References
    ----------
    A. Siddiqi, *Identification of the Harmonic Transfer Functions of a Helicopter
    Rotor*, M.S. thesis, MIT, 2001 (who smooths over frequency what is averaged over
    segments here); S. Hwang, *Frequency domain system identification of helicopter
    rotor dynamics incorporating models with time periodic coefficients*, Ph.D. thesis,
    University of Maryland, 1997.

    Examples
    --------
    Modulation, y = cos(ψ) u, has H_1 = H_−1 = 1/2:

    >>> t = np.arange(6000) * 0.1
    >>> u = pd.Series(np.random.default_rng(0).standard_normal(6000), t, name="u")
    >>> y = (np.cos(2.0 * t) * u).rename("y")
    >>> estimate = estimate_harmonic_transfer_function(u, y, 2.0, 1)
    >>> bool(np.allclose(estimate.harmonic(1), 0.5))
    True
    >>> bool(np.allclose(estimate.harmonic(0), 0.0, atol=1e-12))
    True
    """
    omega = check_positive("omega", omega, "rad/s", "the fundamental frequency")
    N = check_count("n_harmonics", n_harmonics, 0, "harmonics of the response")
    overlap = check_fraction("overlap", overlap, "it is a share of the segment", zero=True)
    _check_window(window)
    u, y = as_container(u, "u"), as_container(y, "y")
    check_same_rows(u, y)
    base = read_time(u, sample_time, check_time_origin(time_origin))
    if sample_time is None:
        warn_if_counted(base)
    dt = base.sample_time
    if base.jitter[1] > 1e-3 * dt:
        raise ValueError(
            f"rows are unevenly spaced, off a grid of {dt:.6g} s by up to {base.jitter[1]:.2g} s; "
            f"resample them first"
        )
    inputs, input_names = _signals(u, "u", base)
    outputs, output_names = _signals(y, "y", base)
    highest = max(N, 1)
    if np.pi / dt <= highest * omega:
        raise ValueError(
            f"harmonic {highest} of omega={omega:.6g} rad/s lies beyond half the sampling "
            f"frequency, {np.pi / dt:.6g} rad/s; sample faster or lower n_harmonics"
        )
    lengths = [segment.stop - segment.start for segment in base.segments]
    n_unknowns = (2 * N + 1) * len(input_names)
    n_segment = _segment_length(
        lengths, 2.0 * np.pi / (omega * dt), n_unknowns, periods_per_segment, window, overlap
    )
    frequencies, response, std, coherence, n_averages = estimate_harmonic_transfer(
        [inputs[segment] for segment in base.segments],
        [outputs[segment] for segment in base.segments],
        [times_near_zero_phase(base.time[segment], omega) for segment in base.segments],
        omega,
        N,
        n_segment,
        window=window,
        overlap=overlap,
    )
    return HarmonicTransferFunction(
        omega,
        frequencies,
        response,
        input_names,
        output_names,
        std=std,
        coherence=coherence,
        n_averages=float(n_averages),
    )


def _check_window(window):
    """Raise ValueError if scipy.signal does not know the window."""
    try:
        known = np.all(np.isfinite(get_window(window, 64)))
    except (TypeError, ValueError, OverflowError, np.linalg.LinAlgError):
        known = False
    if not known:
        raise ValueError(
            f"window={reprlib.repr(window)} is not a window of scipy.signal.get_window; 'hann' is "
            f"usual"
        )


def _signals(data, what, base):
    """Values of shape (n_rows, n_signals) and their names."""
    names = signal_names(data, what)
    return check_values(to_float(data, what), names, base.time, what, missing=None), names


def _segment_length(lengths, samples_per_period, n_unknowns, periods, window, overlap):
    """Length of a segment in samples that leaves enough averages, chosen or checked."""

    def averages(n_periods):
        n_segment = round(n_periods * samples_per_period)
        if n_segment > max(lengths):
            return 0.0
        weights, step = segment_plan(n_segment, window, overlap)
        counts = [max(0, (length - n_segment) // step + 1) for length in lengths]
        return sum(effective_averages(weights, step, count) for count in counts)

    if periods is None:
        longest, fewest = int(max(lengths) / samples_per_period), 4  # which tell harmonics apart
        candidates = range(max(longest, fewest), fewest, -1)
        periods = next((p for p in candidates if averages(p) >= 10 * n_unknowns), fewest)
    periods = check_count("periods_per_segment", periods, 1, "periods of omega in a segment")
    if averages(periods) <= n_unknowns:
        raise ValueError(
            f"the records hold {averages(periods):.3g} independent segments of {periods} periods, "
            f"but the harmonics of all inputs are {n_unknowns} unknowns at each frequency; lower "
            f"periods_per_segment or n_harmonics, or give longer records"
        )
    return round(periods * samples_per_period)
