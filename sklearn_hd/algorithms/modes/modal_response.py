"""Response of a periodic system in modal coordinates, fitted to raw signals.

With the Floquet exponents in R, real and block-diagonal,

    ż = R z + B(ψ) u,   y = O(ψ) C z,   B(ψ) = B_0 + Σ_q (B_qc cos qψ + B_qs sin qψ),

where O(ψ) holds the harmonic functions kept of each output (Eq. 7). With B constant this
is the response of a harmonic decomposition, mode by mode; with harmonics in B, that of
a linear time-periodic system, O(ψ) C being its mode shapes P(ψ). A Gauss-Newton iteration on
R, B, C and the initial states leads to the least squares of y itself, which under white
noise is the maximum of the likelihood: no analyzer stands between (Ljung, 1999, section 7).
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.signal import lfilter

from sklearn_hd.algorithms.reporting import stage

__all__ = ["ModalModel", "Record", "fit_modal_model", "is_white", "residuals"]

SMALL_STEP = 1e-6  # of an exponent, for central differences: exact to about 1e-10
SETTLED = 0.01  # a step that gains less, in variances of the residual, is the last
MAX_STEPS = 15
RANK = 1e-13  # exponents near one another give responses that are nearly alike
DAMPING, MAX_DAMPING = 1e-9, 1e3
MAX_GROWTH = 20.0  # e-folds over the longest segment
WHITE_SPREADS = 4.0


@dataclass(frozen=True)
class ModalModel:
    """A system in modal coordinates, and how well it explains a record.

    Attributes
    ----------
    exponents : complex ndarray, shape (n_units,)
        1/s; real ones, and one member of each pair.
    inputs : list of ndarray, shapes (m (2 Q + 1) + n_segments,)
        For each unit the harmonics of its row of B, input by input in the order
        0, 1c, 2c, …, 1s, 2s, …, then its initial states; complex for a pair.
    C : ndarray, shape (n_coefficients, n)
        The columns of a pair are those of the real and the imaginary part of its state.
    residual : float
        Sum of squares left.
    """

    exponents: np.ndarray
    inputs: list
    C: np.ndarray
    residual: float


class Record:
    """Raw signals of some segments, and the responses of single modes to the inputs.

    Parameters
    ----------
    drive, outputs : list of ndarray, shapes (n_samples_s, m) and (n_samples_s, l)
        In like units.
    observe : list of ndarray, shapes (n_samples_s, l, n_coefficients)
        O(ψ) at each sample.
    azimuths : list of ndarray, shapes (n_samples_s,)
        Radians.
    omega, dt : float
        rad/s, and seconds from sample to sample.
    n_harmonics : int
        Q, harmonics of B.
    """

    def __init__(self, drive, outputs, observe, azimuths, omega, dt, n_harmonics=0):
        self.drive, self.azimuths, self.dt = drive, azimuths, dt
        self.turns = 1j * omega * np.arange(n_harmonics + 1)
        self.orders = np.arange(n_harmonics + 1)
        self.fastest_growth = MAX_GROWTH / (max(len(u) for u in drive) * dt)
        self.outputs, self.observe = np.concatenate(outputs), np.concatenate(observe)

    def responses(self, exponent):
        """Responses of ṡ = λ* s + f(ψ) u_j for all f and j, and to each initial state.

        Exact for inputs held from sample to sample. Shape
        (n_samples, m (2 Q + 1) + n_segments), complex.
        """
        pole = np.exp(np.conj(exponent) * self.dt)
        plus, minus = (self._gains(np.conj(exponent), turns) for turns in (self.turns, -self.turns))
        blocks = []
        for s, (u, psi) in enumerate(zip(self.drive, self.azimuths, strict=True)):
            wave = np.exp(1j * np.outer(psi, self.orders))
            up, down = wave * plus, wave.conj() * minus
            waves = np.hstack([(up + down) / 2, ((up - down) / 2j)[:, 1:]])
            forcing = (u[:, :, None] * waves[:, None, :]).reshape(len(u), -1)
            start = np.zeros((len(u), len(self.drive)))
            start[0, s] = 1.0
            forced = lfilter([0.0, 1.0], [1.0, -pole], forcing, axis=0)
            blocks.append(np.hstack([forced, lfilter([1.0], [1.0, -pole], start, axis=0)]))
        return np.concatenate(blocks)

    def _gains(self, rate, turns):
        """∫ e^{λ*(dt−τ)} e^{turn τ} dτ over a sample."""
        gap = (rate - turns) * self.dt
        near = np.abs(gap) < 1e-12
        safe = np.where(near, 1.0, gap)
        return self.dt * np.exp(turns * self.dt) * np.where(near, 1.0, np.expm1(safe) / safe)

    def model_outputs(self, responses, inputs, C):
        """O(ψ) C z."""
        z = _states(responses, inputs)
        return np.einsum("tlc,tc->tl", self.observe, z @ C.T)


def _states(responses, inputs):
    columns = []
    for response, b in zip(responses, inputs, strict=True):
        s = response @ b
        columns += [s.real, s.imag] if np.iscomplexobj(b) else [s.real]
    return np.stack(columns, axis=1)


def _input_columns(shapes, responses, paired):
    """Derivatives of the outputs with respect to ``inputs``, (n_samples l, …)."""
    columns, j = [], 0
    for response, pair in zip(responses, paired, strict=True):
        first = shapes[:, :, j, None]
        if pair:
            second = shapes[:, :, j + 1, None]
            real, imag = response.real[:, None], response.imag[:, None]
            columns += [first * real + second * imag, second * real - first * imag]
        else:
            columns.append(first * response.real[:, None])
        j += 2 if pair else 1
    joined = np.concatenate(columns, axis=-1)
    return joined.reshape(-1, joined.shape[-1])


def _as_inputs(parameters, paired):
    width = len(parameters) // int(np.sum(1 + paired))
    inputs, start = [], 0
    for pair in paired:
        b = parameters[start : start + width]
        start += width
        if pair:
            b = b + 1j * parameters[start : start + width]
            start += width
        inputs.append(b)
    return inputs


def _moved(exponents, step, paired):
    exponents, k = exponents.copy(), 0
    for i, pair in enumerate(paired):
        exponents[i] += step[k] + (1j * step[k + 1] if pair else 0.0)
        k += 2 if pair else 1
    return exponents


def _exponent_columns(record, exponents, responses, inputs, C, paired):
    """Derivatives with respect to Re λ, and Im λ of pairs, by central differences."""
    columns = []
    for i, pair in enumerate(paired):
        size = SMALL_STEP * abs(exponents[i])
        for direction in (1.0, 1j)[: 2 if pair else 1]:
            change = 0.0
            for sign in (1.0, -1.0):
                moved = list(responses)
                moved[i] = record.responses(exponents[i] + sign * size * direction)
                change = change + sign * record.model_outputs(moved, inputs, C)
            columns.append(change.ravel() / (2.0 * size))
    return np.stack(columns, axis=1)


def fit_modal_model(record, exponents, C, report=None):
    """Least squares of the raw outputs over exponents, inputs, shapes and initial states.

    Parameters
    ----------
    record : Record
    exponents : complex ndarray, shape (n_units,)
        To start from, 1/s: real ones, and one member of each pair.
    C : ndarray, shape (n_coefficients, n)
        To start from.
    report : callable, optional
        ``report(stage, most, done, note)``.

    Returns
    -------
    model : ModalModel
    """
    exponents = np.asarray(exponents, dtype=complex)
    paired = exponents.imag != 0.0
    responses = [record.responses(e) for e in exponents]
    regressors = _input_columns(record.observe @ C, responses, paired)
    start = _scaled_solution(regressors, record.outputs.ravel())
    model = _with_residual(record, responses, exponents, _as_inputs(start, paired), C)
    damping, told = DAMPING, stage(report, "likelihood of modes, steps", MAX_STEPS)
    for k in range(MAX_STEPS):
        before = model.residual
        if told is not None:
            told(k, f"variance left {before / np.sum(record.outputs**2):.3g}")
        model, responses, damping = _step(record, model, responses, paired, damping)
        if before - model.residual <= SETTLED * before / record.outputs.size:
            break
    return model


def _scaled_solution(regressors, target):
    size = np.linalg.norm(regressors, axis=0)
    size[size == 0.0] = 1.0
    return linalg.lstsq(regressors / size, target, cond=RANK)[0] / size


def _with_residual(record, responses, exponents, inputs, C):
    left = record.outputs - record.model_outputs(responses, inputs, C)
    return ModalModel(exponents, inputs, C, float(np.sum(left**2)))


def _step(record, model, responses, paired, damping):
    """One Levenberg-Marquardt step; the model itself where none helps."""
    z = _states(responses, model.inputs)
    by_shape = (record.observe[..., None] * z[:, None, None, :]).reshape(
        record.outputs.size, model.C.size
    )
    shapes = record.observe @ model.C
    blocks = [
        by_shape,
        _input_columns(shapes, responses, paired),
        _exponent_columns(record, model.exponents, responses, model.inputs, model.C, paired),
    ]
    jacobian = np.hstack(blocks)
    size = np.linalg.norm(jacobian, axis=0)
    size[size == 0.0] = 1.0
    jacobian /= size
    left = (record.outputs - record.model_outputs(responses, model.inputs, model.C)).ravel()
    normal, gradient = jacobian.T @ jacobian, jacobian.T @ left
    edges = np.cumsum([block.shape[1] for block in blocks])
    while damping <= MAX_DAMPING:
        # scales of B and C that cancel leave directions without effect: damping rests them
        step = linalg.solve(normal + damping * np.eye(len(normal)), gradient, assume_a="pos") / size
        exponents = _moved(model.exponents, step[edges[1] :], paired)
        if np.max(exponents.real) > max(record.fastest_growth, np.max(model.exponents.real)):
            damping *= 100.0
            continue
        moved = [record.responses(e) for e in exponents]
        change = _as_inputs(step[edges[0] : edges[1]], paired)
        inputs = [b + d for b, d in zip(model.inputs, change, strict=True)]
        C = model.C + step[: edges[0]].reshape(model.C.shape)
        trial = _with_residual(record, moved, exponents, inputs, C)
        if trial.residual < model.residual:
            return trial, moved, max(DAMPING, damping / 10.0)
        damping *= 100.0
    return model, responses, damping


def residuals(record, model):
    """Outputs less those of the model, shape (n_samples, l)."""
    responses = [record.responses(e) for e in model.exponents]
    return record.outputs - record.model_outputs(responses, model.inputs, model.C)


def is_white(left, lags):
    """Whether residuals look like white noise over some lags, each output by itself.

    With ρ_k the autocorrelation at lag k of n samples, n Σ ρ_k² has mean L and variance
    2 L over L lags of white noise (Box and Pierce, 1970); four spreads above the mean it
    is none.

    Parameters
    ----------
    left : ndarray, shape (n_samples, l)
    lags : int

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal((2000, 1))
    >>> is_white(noise, 20), is_white(np.cumsum(noise, axis=0), 20)
    (True, False)
    """
    n = len(left)
    spectrum = np.abs(np.fft.rfft(left, 2 * n, axis=0)) ** 2
    covariance = np.fft.irfft(spectrum, axis=0)[: lags + 1]
    if not covariance[0].all():
        return False
    statistic = n * np.sum((covariance[1:] / covariance[0]) ** 2, axis=0)
    return bool(np.all(statistic <= lags + WHITE_SPREADS * np.sqrt(2.0 * lags)))
