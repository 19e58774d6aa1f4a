"""Records of a rotor in service: a blade in forward flight, as measured."""

import numpy as np
import pandas as pd
from sklearn.utils import Bunch, check_random_state

from sklearn_hd._checks import check_count, check_numbers, check_positive
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, harmonic_labels
from sklearn_hd.systems import LTPSystem, flapping_blade

ACTUATOR = 0.7  # 1/rad: blade pitch follows what is asked
GUST = 0.3  # 1/rad: a gust passes
INFLOW = (-0.03, 0.02, 0.0, 0.0, 0.01, 0.003, 0.002)  # fixed in space: harmonics 0, 1c, 1s, …
N_LOADS = 12  # harmonics of the forced response
SPEED_TURNS = (13.0, 31.0, 73.0)  # periods of what the speed varies by, in turns

DESCRIPTION = """\
Flapping of a rotor blade in forward flight (sklearn_hd.systems.flapping_blade, gamma={gamma:g},
mu={mu:g}, nu={nu:g}) behind an actuator, at omega={omega:g} rad/s, {per_turn:.4g} samples a turn.
The pitch asked for steps at random every {hold} samples, from the first to the last. Inflow that
is fixed in space loads the blade at every turn; gusts of {turbulence:g} of the tip speed shake it;
the sensor's noise is {noise:g} of what the input does. The speed varies by {variation:g}.
"""


def make_rotor(
    *,
    n_turns=600,
    sample_time=0.01,
    omega=38.8,
    gamma=5.0,
    mu=0.4,
    nu=1.2,
    pitch=0.02,
    hold=3,
    turbulence=0.002,
    noise=0.01,
    speed_variation=0.0,
    random_state=None,
):
    """Record of a rotor blade in service, together with the truth.

    The blade flaps in forward flight (:func:`~sklearn_hd.systems.flapping_blade`). Its pitch θ
    follows the commanded pitch θ_c. The air comes through the disc from below; as a share of the
    tip speed it is an inflow λ(ψ) fixed in space plus a gust w:

        β″ + γ/8 (1 + 4/3 μ sin ψ) β′ + (ν² + γ/8 (4/3 μ cos ψ + μ² sin 2ψ)) β
            = γ/8 (1 + 8/3 μ sin ψ + 2 μ² sin² ψ) θ + γ (1/6 + μ/4 sin ψ) (λ(ψ) + w),
        θ′ = 0.7 (θ_c − θ),    w′ = −0.3 w + white noise

    with ′ = d/dψ. Nothing rests: no span is in trim, and in general a turn does not hold a whole
    number of samples.

    Parameters
    ----------
    n_turns : int, default=600
        Length of the record.
    sample_time : float, default=0.01
        Seconds from sample to sample.
    omega : float, default=38.8
        Mean speed Ω of the rotor in rad/s; with ``sample_time`` it gives 16.19 samples per turn.
    gamma, mu, nu : float, default=5.0, 0.4, 1.2
        Lock number, advance ratio and flap frequency of the blade.
    pitch : float, default=0.02
        Size of the steps of the commanded pitch, rad; each is up, down or none.
    hold : int, default=3
        Samples from one step to the next.
    turbulence : float, default=0.002
        Standard deviation of the gust w, as a share of the tip speed.
    noise : float, default=0.01
        Standard deviation of the sensor's white noise, as a share of that of the response to the
        input.
    speed_variation : float, default=0.0
        Standard deviation of the speed as a share of its mean: slow waves, the fastest over 13
        turns. The dynamics of the blade scale with the rotor speed.
    random_state : int, RandomState or None, default=None
        For steps, gusts, noise and speed.

    Returns
    -------
    data : Bunch
        With these attributes:

        inputs : DataFrame, (n_samples, 1)
            Column pitch, θ_c in rad, indexed by time in seconds.
        outputs : DataFrame, (n_samples, 1)
            Column flap, the angle β in rad as measured.
        azimuth : Series, (n_samples,)
            ψ in rad as from an encoder, starting again at each turn; its name is psi.
        response : DataFrame, (n_samples, 1)
            Part of the flap angle that the input causes.
        outputs_clean : DataFrame, (n_samples, 1)
            The flap angle without the sensor's noise.
        loads : DataFrame, (25, 1)
            Fourier coefficients of the forced periodic flap angle, which the inflow causes.
        omega : float
            Ω.
        sample_time : float
            Seconds.
        samples_per_turn : float
            Whole or not.
        exponents : complex ndarray, (3,)
            Floquet exponents of blade and actuator in 1/s, the slowest first.
        gust_exponent : float
            Exponent of the gust, −0.3 Ω; it is a state of any model that predicts ahead.
        ltp : LTPSystem
            Blade and actuator, driven by pitch and gust.
        DESCR : str
            How the data were made.

    Raises
    ------
    ValueError
        If an argument is not allowed.

    References
    ----------
    W. Johnson, *Helicopter Theory*, Princeton University Press, 1980, sections 5-5 and 12-1
    (flap moments due to pitch and inflow).

    Examples
    --------
    >>> data = make_rotor(n_turns=50, random_state=0)
    >>> data.inputs.shape, round(data.samples_per_turn, 2)
    ((809, 1), 16.19)
    >>> data.exponents.round(1).tolist()
    [(-12.1-5.8j), (-12.1+5.8j), (-27.2+0j)]
    """
    n_turns = check_count("n_turns", n_turns, 2, "the length of the record")
    hold = check_count("hold", hold, 1, "samples from step to step")
    omega = check_positive("omega", omega, "rad/s", "it is the rotor speed")
    sample_time = check_positive("sample_time", sample_time, "seconds", "it separates samples")
    sizes = {"pitch": pitch, "turbulence": turbulence, "noise": noise}
    check_numbers("nonnegative", "0 leaves it out", **sizes, speed_variation=speed_variation)
    rng, ltp = check_random_state(random_state), _rotor(gamma, mu, nu, omega)
    per_turn = 2.0 * np.pi / (omega * sample_time)
    n = int(n_turns * per_turn)
    t = np.arange(n) * sample_time
    psi = _azimuth(t, omega, speed_variation, rng)
    if np.any(np.diff(psi) <= 0.0):
        raise ValueError(
            f"speed_variation={speed_variation:g} makes the rotor stand still or turn back; it is "
            f"a share of the mean speed, and 0.1 is already large"
        )
    asked = pitch * np.repeat(rng.choice([-1.0, 0.0, 1.0], -(-n // hold)), hold)[:n]
    gust = turbulence * _gusts(np.diff(psi, append=psi[-1] + omega * sample_time), rng)
    loads = _forced_response(ltp)
    orbit = harmonic_functions(psi, range(N_LOADS + 1)) @ loads
    drives = np.zeros((2, n, 2))  # of the input alone, of gusts alone: what is linear adds up
    drives[0, :, 0], drives[1, :, 1] = asked, gust
    response, shaken = ltp.simulate(drives, psi / omega)
    clean = orbit + response + shaken
    measured = clean + noise * response.std() * rng.standard_normal((n, 1))

    index, names = pd.Index(t, name="time"), list(ltp.output_names)
    labels = pd.Index(harmonic_labels(range(N_LOADS + 1)), name="coefficient")
    return Bunch(
        inputs=pd.DataFrame({"pitch": asked}, index),
        outputs=pd.DataFrame(measured, index, names),
        azimuth=pd.Series(np.mod(psi, 2.0 * np.pi), index, name="psi"),
        response=pd.DataFrame(response, index, names),
        outputs_clean=pd.DataFrame(clean, index, names),
        loads=pd.DataFrame(loads, labels, names),
        omega=omega,
        sample_time=sample_time,
        samples_per_turn=per_turn,
        exponents=ltp.floquet_exponents(),
        gust_exponent=-GUST * omega,
        ltp=ltp,
        DESCR=DESCRIPTION.format(
            gamma=gamma,
            mu=mu,
            nu=nu,
            omega=omega,
            per_turn=per_turn,
            hold=hold,
            turbulence=turbulence,
            noise=noise,
            variation=speed_variation,
        ),
    )


def _rotor(gamma, mu, nu, omega):
    """Blade and actuator, driven by pitch and gust."""
    blade = flapping_blade(gamma=gamma, mu=mu, nu=nu, omega=omega)
    F2, G2, _, _ = blade.fourier_coefficients(2)
    F, G = np.zeros((5, 3, 3)), np.zeros((5, 3, 2))
    F[:, :2, :2], F[:, :2, 2:] = F2, G2
    F[0, 2, 2], G[0, 2, 0] = -ACTUATOR * omega, ACTUATOR * omega
    G[0, 1, 1], G[2, 1, 1] = omega**2 * gamma / 6.0, omega**2 * gamma * mu / 4.0  # 1, sin ψ
    return LTPSystem(
        F,
        G,
        np.eye(1, 3),
        omega=omega,
        state_names=[*blade.state_names, "theta"],
        input_names=["pitch", "gust"],
        output_names=["flap"],
    )


def _forced_response(ltp):
    """Fourier coefficients (2 N_LOADS + 1, 1) of the outputs under the inflow, at rest else."""
    hd = ltp.harmonic_decomposition(N_LOADS)
    inflow = np.zeros((hd.ninputs // 2, 2))
    inflow[: len(INFLOW), 1] = INFLOW
    x = np.linalg.solve(-hd.A, hd.B @ inflow.ravel())
    return (hd.C @ x).reshape(-1, 1)


def _azimuth(t, omega, variation, rng):
    """ψ of a speed that slow waves of random phase change, radians."""
    rates = omega / np.array(SPEED_TURNS)
    phases = rng.uniform(0.0, 2.0 * np.pi, len(rates))
    waves = np.sin(np.outer(t, rates) + phases) - np.sin(phases)
    size = variation * np.sqrt(2.0 / len(rates))
    return omega * (t + size * waves @ (1.0 / rates))


def _gusts(steps, rng):
    """First-order noise of unit variance, of some steps in azimuth."""
    kept = np.exp(-GUST * steps)
    kicks = rng.standard_normal(len(steps)) * np.sqrt(1.0 - kept**2)
    w, gusts = rng.standard_normal(), np.empty(len(steps))
    for k, (share, kick) in enumerate(zip(kept, kicks, strict=True)):
        gusts[k] = w
        w = share * w + kick
    return gusts
