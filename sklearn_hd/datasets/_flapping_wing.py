"""Records of the flapping wing, as an experiment on the paper's vehicle would give them."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pandas as pd
from sklearn.utils import Bunch, check_random_state

from sklearn_hd._checks import check_choice, check_count, check_numbers, real_array
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate
from sklearn_hd.algorithms.signals.fourier import recompose
from sklearn_hd.systems import LTPSystem, PeriodicSystem, flapping_wing

KINDS = ("lti", "lti-signal", "ltp", "nltp")
TRIM_HARMONICS = 512  # the orbit to 3e-10 of its size; w has a kink wherever the wing reverses

DESCRIPTION = """\
Vertical flight of a flapping-wing micro air vehicle (Aerospace 2024, 11(11), 875, Eq. 23)
about hover, driven by changes dU of the flapping torque's amplitude. Kind: {kind}.
Subsystem: {subsystem}. Trim U* = {torque:.8g}, omega = {omega:.8g} rad/s; {harmonics} harmonics
in the trim that A_exact and the data share. Inputs are held from sample to sample
({samples_per_period} a period, sample time {sample_time:.6g} s).
"""


@dataclass(frozen=True)
class _Subsystem:
    """One of the two uncoupled halves of the harmonic-decomposition model with N = 1."""

    input: str  # coefficient of U that drives it
    states: tuple  # as in the paper's Eq. 26
    constant: str  # signal that has harmonic 0, the other having 1c and 1s
    modulation: tuple  # coefficients (0, 1c, 1s) of what multiplies the amplitude


SUBSYSTEMS = {
    "heave": _Subsystem("U_0", ("w_0", "phi_dot_1c", "phi_dot_1s"), "w", (1.0, 0.0, 0.0)),
    "flap": _Subsystem("U_1c", ("phi_dot_0", "w_1c", "w_1s"), "phi_dot", (0.0, 1.0, 0.0)),
}


def make_flapping_wing(
    kind="ltp",
    *,
    n_periods=220,
    samples_per_period=64,
    start=132,
    width=10,
    amplitude=0.02,
    offset=0.0,
    input="doublet",
    n_records=1,
    snr=None,
    snr_db=None,
    noise_on="outputs",
    subsystem="heave",
    random_state=None,
):
    """Simulated records of the flapping wing about hover, together with the truth.

    The amplitude of the flapping torque is changed by ΔU(t) about its trim value U*,
    and the vertical speed w and flapping speed φ̇ respond. All kinds share one trim
    (Eq. 23, mean w zero), so one A_exact holds for all.

    Parameters
    ----------
    kind : {"lti", "lti-signal", "ltp", "nltp"}, default="ltp"
        ``"lti"``: harmonic coefficients of the response of the harmonic-decomposition model with N
        = 1, as a perfect analyzer would give them; ``"lti-signal"``: the same combined to w and φ̇
        (Eq. 7); ``"ltp"``: perturbations of the linear time-periodic model; ``"nltp"``: raw
        measurements of the nonlinear system, which include the periodic trim and, in the input,
        U*.
    n_periods : int, default=220
        Length of each record.
    samples_per_period : int, default=64
        Rows of one flapping period.
    start : float, default=132
        Period in which a doublet begins (132 are the paper's 5 s).
    width : float, default=10
        Number of periods that a doublet is up, and then down; unit step of a 3211.
    amplitude : float or sequence of float, default=0.02
        Largest change of the input, as a share of U*; a negative value reverses the input. A
        sequence gives one record for each value, of the same waveform.
    offset : float, default=0.0
        Shift of all edges as a share of a period. Edges are rounded to the nearest
        sample.
    input : {"doublet", "3211", "multisine"} or array_like, default="doublet"
        ``"doublet"``: up, then down, once. ``"3211"``: steps of 3, 2, 1 and 1 widths,
        up and down in turn, repeated to the end. ``"multisine"``: all frequencies up to 0.4 cycles
        per period with random phases, one value held for each period. The latter two begin after
        four quiet periods; for kind "nltp" after a tenth of the record if that is more, so that
        the trim can be averaged there. An array is ΔU itself, in the units of U, of shape
        (n_samples,) or (n_records, n_samples).
    n_records : int, default=1
        More than one gives a (record, time) index. The first record has the given input; the
        others differ at random in sign, width and size (doublet, 3211) or in
        phases (multisine).
    snr, snr_db : float, optional
        Ratio of the standard deviation of each column (perturbation only, over all
        records) to that of the white Gaussian noise added to it, plain or in decibels
        (20 log₁₀). Without either, no noise.
    noise_on : {"outputs", "both"}, default="outputs"
        Signals that get the noise; ``"both"`` is inputs and outputs.
    subsystem : {"heave", "flap"}, default="heave"
        ``"heave"``: ΔU is the amplitude itself, U₀; outputs w₀, φ̇_1c, φ̇_1s.
        ``"flap"``: ΔU is U_1c, so that the input is U_1c cos ψ; outputs φ̇₀, w_1c, w_1s.
        The cosine acts continuously, U_1c is held between samples.
    random_state : int, RandomState or None, default=None
        For phases, the further records and noise.

    Returns
    -------
    data : Bunch
        With these attributes:

        inputs : DataFrame, (n_samples, 1)
            Column U, indexed by time in seconds. Perturbations, except for "nltp"; with
            kind "lti" and subsystem "flap" the column holds U_1c.
        outputs : DataFrame, (n_samples, 2), or (n_samples, 3) for kind "lti"
            Columns w and phi_dot, or the subsystem's three coefficients.
        inputs_clean, outputs_clean : DataFrame
            The same without noise.
        omega : float
            Flapping frequency, rad/s.
        sample_time : float
            Seconds.
        A_exact : DataFrame, (3, 3)
            State matrix of the subsystem in the harmonic-decomposition model (N = 1) of
            ``ltp``, in 1/s.
        B_exact : DataFrame, (3, 1)
            Its input matrix.
        ltp : LTPSystem
            The linear time-periodic system, driven by the raw ΔU.
        system : PeriodicSystem
            The nonlinear system.
        trim : Trim
            The periodic solution that all kinds share.
        trim_span : tuple of float or None
            (0, time of the first change of any record's input) in seconds, within each record;
            None if that is shorter than a period.
        DESCR : str
            How the data were made.

    Raises
    ------
    ValueError
        If an argument is not allowed, or the input does not fit in the record.

    References
    ----------
    M. A. Hayajnh, U. Saetti, J. V. R. Prasad, Aerospace 2024, 11(11), 875, sections 3, 4.

    Examples
    --------
    >>> data = make_flapping_wing("ltp", n_periods=30, start=5)
    >>> data.inputs.shape, list(data.outputs.columns)
    ((1920, 1), ['w', 'phi_dot'])
    >>> print(data.A_exact.round(1).to_string())
                   w_0  phi_dot_1c  phi_dot_1s
    w_0           -4.0        -0.0        -0.1
    phi_dot_1c  -852.9       -55.3      -179.8
    phi_dot_1s -2817.9       150.7       -95.9
    """
    check_choice("kind", kind, KINDS)
    check_choice("subsystem", subsystem, tuple(SUBSYSTEMS))
    check_choice("noise_on", noise_on, ("outputs", "both"))
    n_periods = check_count("n_periods", n_periods, 1, "the length of a record")
    samples_per_period = check_count(
        "samples_per_period", samples_per_period, 3, "64 resolve a flap"
    )
    check_numbers("finite", "it counts periods", start=start, width=width, offset=offset)
    amplitudes = _check_amplitudes(amplitude, n_records)
    ratio = _noise_ratio(snr, snr_db)
    rng = check_random_state(random_state)
    truth, part = _truth(), SUBSYSTEMS[subsystem]
    size = amplitudes[0] * truth.torque
    quiet = max(4, n_periods // 10) if kind == "nltp" else 4
    du = _excitation(
        input, n_periods, samples_per_period, start, width, size, offset, n_records, quiet, rng
    )
    if len(amplitudes) > 1:
        du = du * (amplitudes / amplitudes[0])[:, None]
    sample_time = truth.ltp.period / samples_per_period
    t = np.arange(du.shape[1]) * sample_time
    u, y, u_trim, y_trim = _RESPONSES[kind](truth, part, du, t)

    index = record_index(t, len(du))
    output_names = part.states if kind == "lti" else truth.ltp.output_names
    inputs, outputs = record_frame(u, ["U"], index), record_frame(y, output_names, index)
    noisy_outputs = _with_noise(outputs, y - y_trim, ratio, rng)
    noisy_inputs = _with_noise(inputs, u - u_trim, ratio if noise_on == "both" else None, rng)
    A, B = truth.exact(part)
    return Bunch(
        inputs=noisy_inputs,
        outputs=noisy_outputs,
        inputs_clean=inputs,
        outputs_clean=outputs,
        omega=truth.ltp.omega,
        sample_time=sample_time,
        A_exact=A,
        B_exact=B,
        ltp=truth.ltp,
        system=truth.system,
        trim=truth.trim,
        trim_span=_trim_span(du, t, samples_per_period),
        DESCR=DESCRIPTION.format(
            kind=kind,
            subsystem=subsystem,
            torque=truth.torque,
            omega=truth.ltp.omega,
            harmonics=truth.trim.n_harmonics,
            samples_per_period=samples_per_period,
            sample_time=sample_time,
        ),
    )


# ---- the truth ----------------------------------------------------------------------------


class _Truth:
    """System, trim, linear time-periodic model and its decomposition: one for all kinds."""

    def __init__(self):
        self.system = flapping_wing()
        self.trim = self.system.trim(TRIM_HARMONICS, method="shooting")
        self.ltp = self.system.linearize(self.trim)
        hd = self.ltp.harmonic_decomposition(1)
        self.A = pd.DataFrame(hd.A, hd.state_labels, hd.state_labels)
        self.B = pd.DataFrame(hd.B, hd.state_labels, hd.input_labels)

    @property
    def torque(self):
        return float(self.trim.inputs[0])

    def exact(self, part):
        """A and B of one subsystem, as copies."""
        states = list(part.states)
        return self.A.loc[states, states].copy(), self.B.loc[states, [part.input]].copy()


@cache
def _truth():
    return _Truth()


# ---- responses: (truth, part, du, t) -> u, y and their trim parts, (records, samples, …) -----


def _lti_response(truth, part, du, t):
    A, B = (M.to_numpy() for M in truth.exact(part))
    A_d, B_d = continuous_to_discrete(A, B, t[1] - t[0])
    x = propagate(A_d, du[..., None] * B_d[:, 0], np.zeros((len(du), len(A))))
    return du[..., None], x, 0.0, 0.0


def _lti_signal_response(truth, part, du, t):
    _, x, _, _ = _lti_response(truth, part, du, t)
    psi = truth.ltp.omega * t
    mean, first = x[..., 0], recompose(x[..., 1:], psi, [1])
    signals = (mean, first) if part.constant == "w" else (first, mean)
    return _raw_input(part, du, psi), np.stack(signals, axis=-1), 0.0, 0.0


def _ltp_response(truth, part, du, t):
    ltp = truth.ltp

    def G(psi):
        return ltp.G(psi) * recompose(part.modulation, psi, [0, 1])[:, None, None]

    driven = LTPSystem(ltp.F, G, omega=ltp.omega)
    return _raw_input(part, du, ltp.omega * t), driven.simulate(du[..., None], t), 0.0, 0.0


def _nltp_response(truth, part, du, t):
    system, trim = truth.system, truth.trim
    mean, cosine, _ = part.modulation

    def f(x, u, t):
        return system.f(x, truth.torque + u * (mean + cosine * np.cos(system.omega * t)), t)

    driven = PeriodicSystem(
        f,
        period=system.period,
        state_names=system.state_names,
        input_names=system.input_names,
    )
    y = np.stack([driven.simulate(one, t, trim.initial_state) for one in du])
    u = truth.torque + _raw_input(part, du, system.omega * t)
    return u, y, truth.torque, trim.states(system.omega * t)


_RESPONSES = {
    "lti": _lti_response,
    "lti-signal": _lti_signal_response,
    "ltp": _ltp_response,
    "nltp": _nltp_response,
}


def _raw_input(part, du, psi):
    """ΔU at the samples: the amplitude times 1 or cos ψ."""
    return (du * recompose(part.modulation, psi, [0, 1]))[..., None]


# ---- inputs: changes ΔU of shape (records, samples) ------------------------------------------


def _excitation(input, n_periods, spp, start, width, size, offset, n_records, quiet, rng):
    n_samples = n_periods * spp
    n_records = check_count("n_records", n_records, 1, "it is the number of records")
    if not isinstance(input, str):
        return _given(input, n_samples, n_records)
    check_choice("input", input, ("doublet", "3211", "multisine"))
    if not width * spp >= 1:
        raise ValueError(
            f"width={width} is shorter than a sample; it counts periods, so give {1 / spp:g} or "
            f"more"
        )
    if input == "doublet":
        records = _doublets(n_samples, spp, start + offset, width, size, n_records, rng)
    else:
        build = _steps_3211 if input == "3211" else _multisines
        first = round((quiet + offset) * spp)
        if not 0 <= first < n_samples - spp:
            raise ValueError(
                f"n_periods={n_periods} leaves nothing of the {input} after {quiet} quiet "
                f"periods and offset={offset}; raise n_periods"
            )
        records = np.zeros((n_records, n_samples))
        records[:, first:] = build(n_samples - first, spp, width, size, n_records, rng)
    return records


def _given(du, n_samples, n_records):
    """The user's own ΔU, checked."""
    wanted = f"{n_samples} finite samples of dU for each record"
    du = np.atleast_2d(np.array(real_array("input", du, wanted)))
    if du.ndim != 2 or du.shape[1] != n_samples or n_records not in (1, len(du)):
        raise ValueError(
            f"input has shape {du.shape}; as an array it must have n_periods * samples_per_period "
            f"= {n_samples} samples, in one row for each of n_records={n_records} records"
        )
    return du


def _doublets(n_samples, spp, start, width, size, n_records, rng):
    """Up for a width, down for a width; further records differ in sign, width and size."""
    first, length = round(start * spp), round(width * spp)
    if first < 0 or first + 2 * length > n_samples:
        raise ValueError(
            f"a doublet from period {start:g} to {start + 2 * width:g} does not fit in "
            f"{n_samples // spp} periods; change start, width or offset, or raise n_periods"
        )
    records = np.zeros((n_records, n_samples))
    for record, (scale, stretch) in zip(records, _variations(n_records, rng), strict=True):
        step = min(_step_length(width, stretch, spp), (n_samples - first) // 2)
        record[first : first + step] = scale * size
        record[first + step : first + 2 * step] = -scale * size
    return records


def _steps_3211(n_samples, spp, width, size, n_records, rng):
    """Steps of 3, 2, 1, 1 widths, up and down in turn, repeated to the end."""
    records = np.empty((n_records, n_samples))
    for record, (scale, stretch) in zip(records, _variations(n_records, rng), strict=True):
        unit = _step_length(width, stretch, spp)
        pattern = np.repeat([1.0, -1.0, 1.0, -1.0], np.multiply([3, 2, 1, 1], unit))
        record[:] = scale * size * np.resize(pattern, n_samples)
    return records


def _multisines(n_samples, spp, width, size, n_records, rng):
    """Sum of cosines of random phase, one value a period, of given peak."""
    n_values = -(-n_samples // spp)
    cycles = np.arange(1, int(0.4 * n_values) + 1) / n_values
    if not len(cycles):
        raise ValueError(
            f"a multisine needs three periods or more after the quiet ones, but {n_values} are "
            f"left; raise n_periods"
        )
    phases = rng.uniform(0.0, 2.0 * np.pi, (n_records, len(cycles)))
    values = np.cos(2.0 * np.pi * np.outer(np.arange(n_values), cycles) + phases[:, None]).sum(-1)
    values *= size / np.max(np.abs(values), axis=1, keepdims=True)
    return np.repeat(values, spp, axis=1)[:, :n_samples]


def _step_length(width, stretch, spp):
    """Samples of a step; of a varied one, whole periods if the width is at least one."""
    varied = width * stretch
    if stretch != 1.0 and width >= 1:
        varied = max(1, round(varied))
    return max(1, round(varied * spp))


def _variations(n_records, rng):
    """(scale, stretch) of each record: 1, 1 for the first, random for the others."""
    yield 1.0, 1.0
    for _ in range(n_records - 1):
        yield rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 1.0), rng.uniform(0.5, 1.5)


def _trim_span(du, t, spp):
    """Time before anything moves, if it is a period or more."""
    moved = np.flatnonzero(np.any(du != 0.0, axis=0))
    first = moved[0] if len(moved) else len(t)
    end = first * (t[1] - t[0])
    return (0.0, float(end)) if first >= spp else None


# ---- frames, noise, checks -----------------------------------------------------------------


def record_index(t, n_records):
    """Times t in seconds, repeated for each record if there are several."""
    if n_records == 1:
        return pd.Index(t, name="time")
    return pd.MultiIndex.from_product([range(n_records), t], names=["record", "time"])


def record_frame(values, names, index):
    """Signals of shape (n_records, n_samples, …) as a table with a column for each name."""
    return pd.DataFrame(values.reshape(len(index), -1), index, list(names))


def _with_noise(frame, perturbation, ratio, rng):
    """Frame with white noise of the perturbation's standard deviation / ratio."""
    if ratio is None:
        return frame.copy()
    deviation = np.std(perturbation.reshape(len(frame), -1), axis=0) / ratio
    return frame + deviation * rng.standard_normal(frame.shape)


def _noise_ratio(snr, snr_db):
    if snr is not None and snr_db is not None:
        raise ValueError(f"snr={snr} and snr_db={snr_db} are both given; give one of them")
    ratio = snr if snr_db is None else 10.0 ** (snr_db / 20.0)
    if ratio is not None and not (np.isfinite(ratio) and ratio > 0):
        given = f"snr={snr}" if snr_db is None else f"snr_db={snr_db}"
        raise ValueError(f"{given} must be a positive ratio of standard deviations, or None")
    return ratio


def _check_amplitudes(amplitude, n_records):
    """One finite amplitude, or several, none of them zero, for records of one waveform."""
    try:
        amplitudes = np.atleast_1d(np.array(amplitude, dtype=float))
    except (TypeError, ValueError, OverflowError):
        amplitudes = np.array([np.nan])
    several = np.ndim(amplitude) > 0
    if amplitudes.ndim > 1 or not len(amplitudes) or not np.all(np.isfinite(amplitudes)):
        raise ValueError(f"amplitude={amplitude!r} must be a finite number, or several")
    if several and (n_records != 1 or not np.all(amplitudes)):
        raise ValueError(
            f"amplitude={amplitude!r} makes one record for each value, but n_records={n_records}; "
            f"give amplitudes other than zero and leave n_records at 1"
        )
    return amplitudes
