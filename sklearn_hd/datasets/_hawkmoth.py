"""Records of a hovering hawkmoth, which needs its feedback to hover."""

from dataclasses import replace
from functools import cache

import numpy as np
from sklearn.utils import Bunch, check_random_state

from sklearn_hd._checks import check_count, check_numbers, real_array
from sklearn_hd.datasets._flapping_wing import record_frame, record_index
from sklearn_hd.systems import HeldFeedback, hawkmoth

TRIM_HARMONICS = 128  # the orbit to 5e-8; forces have kinks where a wing element stops
GUSTS = ("u_gust", "w_gust")
STATE_SIZES = (0.3, 0.1, 5.0, 0.2)  # u, w, q, theta that count alike in the regulator
INPUT_SIZES = (0.06, 0.02)  # rad; with them the loop forgets 26 % and more each wingbeat

DESCRIPTION = """\
Surge, heave and pitch of a hovering hawkmoth (sklearn_hd.systems.hawkmoth), held in hover by a
regulator that sets stroke amplitude and mean stroke angle once a wingbeat, from the means of
u, w, q and theta over the wingbeat before, and excited by steps of {excitation} rad that change
sign at random from wingbeat to wingbeat, after {quiet} quiet ones. Gusts: {gust:g} m/s, white
from sample to sample; noise of the sensors: {noise:g} of each output's deviation from the trim.
omega = {omega:.8g} rad/s, {samples_per_period} samples a wingbeat.
"""


def make_hawkmoth(
    *,
    n_records=1,
    n_periods=100,
    samples_per_period=64,
    excitation=0.01,
    quiet=8,
    noise=0.0,
    gust=0.0,
    gain=None,
    random_state=None,
):
    """Simulated flights of a hawkmoth under its stabilising feedback, with the truth.

    The nonlinear moth of :func:`~sklearn_hd.systems.hawkmoth` starts in its trim. Once per
    wingbeat (k) its inputs are set to

        u_k = u* + v_k − K (ȳ_{k−1} − ȳ*)

    from the means ȳ of the measurements. The inputs thus depend on past noise and gusts: methods
    that assume independent inputs are biased.

    Parameters
    ----------
    n_records : int, default=1
        More than one gives a (record, time) index; they cost little more than one.
    n_periods : int, default=100
        Wingbeats of each record.
    samples_per_period : int, default=64
        Rows of one wingbeat.
    excitation : float, (float, float) or array_like, default=0.01
        Size of the steps v in rad, for both inputs or for each; or v itself as an array of shape
        (n_records, n_periods, 2).
    quiet : int, default=8
        Wingbeats without excitation at the beginning.
    noise : float, default=0.0
        Standard deviation of the white noise of the sensors, as a share of each output's root mean
        square departure from the trim without any noise. The feedback reads it.
    gust : float, default=0.0
        Standard deviation in m/s of the wind along the body's x and z axes, held from
        sample to sample and white.
    gain : array_like, shape (2, 4), optional
        K. By default a quadratic regulator's.
    random_state : int, RandomState or None, default=None
        For excitation, gusts and noise.

    Returns
    -------
    data : Bunch
        With these attributes:

        inputs : DataFrame, (n_samples, 2)
            Columns amplitude and mean_angle in rad, including the trim.
        outputs : DataFrame, (n_samples, 4)
            Columns u, w (m/s), q (rad/s) and theta (rad) as measured, including the trim.
        outputs_clean : DataFrame, (n_samples, 4)
            The same motion without noise of the sensors.
        excitation : DataFrame, (n_samples, 2)
            v, held over each wingbeat.
        omega, sample_time : float
            rad/s and seconds.
        gain : ndarray, (2, 4)
            K.
        exponents : complex ndarray, (4,)
            Floquet exponents of the moth without feedback, in 1/s.
        multipliers : complex ndarray, (8,)
            Multipliers of the closed loop over a wingbeat.
        ltp : LTPSystem
            The moth without feedback, linear about its trim.
        system : PeriodicSystem
            The nonlinear moth.
        trim : Trim
            Its periodic solution.
        trim_span : tuple of float or None
            (0, end of the quiet wingbeats) in seconds; None without any.
        DESCR : str
            How the data were made.

    Raises
    ------
    ValueError
        If an argument is not allowed.
    RuntimeError
        If the moth falls because of too much excitation, gust or feedback.

    References
    ----------
    M. Sun, J. K. Wang, "Flight stabilization control of a hovering model insect",
    Journal of Experimental Biology 210 (2007), 2714-2722.

    Examples
    --------
    >>> data = make_hawkmoth(n_periods=12, random_state=0)
    >>> data.inputs.shape, list(data.outputs.columns)
    ((768, 2), ['u', 'w', 'q', 'theta'])
    >>> data.exponents.round(2).tolist()
    [(0.95-5.67j), (0.95+5.67j), (-2.56+0j), (-9.72+0j)]
    >>> bool(abs(data.multipliers[0]) < 0.75)
    True
    """
    n_records = check_count("n_records", n_records, 1, "it is the number of records")
    n_periods = check_count("n_periods", n_periods, 1, "wingbeats of each record")
    S = check_count("samples_per_period", samples_per_period, 4, "64 resolve a wingbeat")
    quiet = check_count("quiet", quiet, 0, "wingbeats before the excitation")
    if quiet > n_periods:
        raise ValueError(
            f"quiet={quiet} exceeds n_periods={n_periods}, the length of a record; lower quiet"
        )
    check_numbers("nonnegative", "0 leaves it out", noise=noise, gust=gust)
    rng, truth = check_random_state(random_state), _truth()
    v = _excitation(excitation, n_records, n_periods, quiet, rng)
    loop = HeldFeedback(
        *truth.windy,
        gain,
        inputs=truth.system.input_names,
        state_sizes=STATE_SIZES,
        input_sizes=INPUT_SIZES,
        samples_per_period=S,
    )
    wind = gust * rng.standard_normal((n_records, n_periods * S, len(GUSTS)))
    u, y, clean = _flights(loop, v, wind, noise, rng)
    sample_time = truth.system.period / S
    index = record_index(np.arange(n_periods * S) * sample_time, n_records)
    signals, states = truth.system.input_names, truth.system.output_names
    return Bunch(
        inputs=record_frame(u[..., :2], signals, index),
        outputs=record_frame(y, states, index),
        outputs_clean=record_frame(clean, states, index),
        excitation=record_frame(v.repeat(S, axis=1), signals, index),
        omega=truth.system.omega,
        sample_time=sample_time,
        gain=loop.gain.copy(),
        exponents=truth.exponents.copy(),
        multipliers=loop.multipliers(),
        ltp=truth.ltp,
        system=truth.system,
        trim=truth.trim,
        trim_span=(0.0, quiet * truth.system.period) if quiet else None,
        DESCR=DESCRIPTION.format(
            excitation=excitation if np.ndim(excitation) < 2 else "given",
            quiet=quiet,
            gust=gust,
            noise=noise,
            omega=truth.system.omega,
            samples_per_period=S,
        ),
    )


@cache
def _truth():
    """The moth, its trim and its linear model; and the same moth in wind."""
    system, windy = hawkmoth(), hawkmoth(extra_inputs=GUSTS)
    trim = system.trim(TRIM_HARMONICS)
    ltp = system.linearize(trim)
    inputs = np.append(trim.inputs, np.zeros(len(GUSTS)))
    calm = replace(trim, inputs=inputs, input_names=windy.input_names)
    exponents = ltp.floquet_exponents()
    return Bunch(system=system, trim=trim, ltp=ltp, exponents=exponents, windy=(windy, calm))


def _flights(loop, v, wind, noise, rng):
    """Inputs, measured outputs and true outputs."""
    substeps = -(-64 // loop.samples_per_period)  # 64 a wingbeat: 2e-6 of q
    u, y = loop.simulate(v, disturbances=wind, substeps=substeps)
    _check_upright(y, loop)
    if not noise:
        return u, y, y
    at_rest = np.tile(loop.trim_samples(), (v.shape[1], 1))
    size = np.sqrt(np.mean((y - at_rest) ** 2, axis=(0, 1)))
    e = noise * size * rng.standard_normal(y.shape)
    u, y = loop.simulate(v, disturbances=wind, noise=e, substeps=substeps)
    _check_upright(y - e, loop)
    return u, y, y - e


def _check_upright(y, loop):
    """Raise RuntimeError if a moth has turned over, because it no longer flies then."""
    pitch = np.abs(y[..., loop.system.output_names.index("theta")])
    if np.max(pitch) > np.pi / 2.0:
        row = int(np.argwhere(np.any(pitch > np.pi / 2.0, axis=0))[0, 0])
        raise RuntimeError(
            f"the moth turns over in wingbeat {row // loop.samples_per_period}; excite it less, or "
            f"give less gust or another gain"
        )


def _excitation(size, n_records, n_periods, quiet, rng):
    """v of shape (n_records, n_periods, 2)."""
    wanted = f"a size in rad, two of them, or an array ({n_records}, {n_periods}, 2)"
    size = real_array("excitation", size, wanted)
    shape = (n_records, n_periods, 2)
    if size.shape == shape:
        return np.array(size)
    if size.shape not in ((), (2,)):
        raise ValueError(f"excitation has shape {size.shape}; give {wanted}")
    v = size * rng.choice([-1.0, 1.0], shape)
    v[:, :quiet] = 0.0
    return v
