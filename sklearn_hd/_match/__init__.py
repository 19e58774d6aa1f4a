"""Step 5: structures matched in a norm, periodic models in closed form, maximum likelihood.

Each route has a module, and gives a ``Match``: a structured model with its parameters.
"""

from dataclasses import dataclass, replace

import numpy as np

from sklearn_hd._checks import check_frequencies
from sklearn_hd._frame import LTIModel, SampleModel
from sklearn_hd._readings import coefficient_names, highest_harmonic
from sklearn_hd._records.likelihood import SearchSettings
from sklearn_hd.algorithms.likelihood.uncertainty import propagate_std
from sklearn_hd.algorithms.lti.simulation import step_response
from sklearn_hd.algorithms.lti.structured_model import AffineStructure, parts_of
from sklearn_hd.algorithms.matching.matching import MatchResult
from sklearn_hd.algorithms.periodic.behind_samples import samples_of
from sklearn_hd.algorithms.periodic.harmonic_balance import trimmed_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import harmonic_decomposition
from sklearn_hd.algorithms.periodic.periodic_innovations import PeriodicInnovations
from sklearn_hd.algorithms.periodic.periodic_structure import PeriodicStructure
from sklearn_hd.algorithms.signals.fourier import mean_square
from sklearn_hd.systems import LTPSystem
from sklearn_hd.systems.arguments import harmonic_names

LIKELIHOODS = ("output_error", "prediction_error")


@dataclass(frozen=True, eq=False, kw_only=True)
class MatchSettings(SearchSettings):
    """How to match, as the matcher was told; a likelihood starts from the mean square."""

    output_weights: object  # as given
    input_weights: object  # as given
    n_starts: int
    random_state: int | None

    @property
    def likely(self):
        """Whether a likelihood continues from the match."""
        return self.criterion in LIKELIHOODS


@dataclass(frozen=True, eq=False)
class PeriodicModel:
    """Linear time-periodic system by its Fourier coefficients, as a value that pickles."""

    coefficients: np.ndarray  # (2 K + 1, n + l, n + m), of [F G; P Q](ψ) in the order 0, 1c, 1s, …
    omega: float  # rad/s
    state_names: tuple
    input_names: tuple
    output_names: tuple

    @property
    def n_states(self):
        """Number of states."""
        return len(self.state_names)

    @property
    def physical(self):
        """Whether the states are outputs, rather than Floquet coordinates."""
        return set(self.state_names) <= set(self.output_names)

    def matrices(self):
        """Fourier coefficients of F, G, P and Q."""
        return parts_of(self.coefficients, self.n_states)

    @property
    def input_size(self):
        """Root mean square over a turn of each entry of G, (n, m)."""
        return np.sqrt(mean_square(self.matrices()[1]))

    def highest(self, name):
        """Highest harmonic of F, G, P or Q that is not zero."""
        return len(trimmed_harmonics(self.matrices()["FGPQ".index(name)])) // 2

    def to_system(self):
        """The model as an LTPSystem."""
        F, G, P, Q = (trimmed_harmonics(M) for M in self.matrices())
        names = {"input_names": self.input_names, "output_names": self.output_names}
        return LTPSystem(F, G, P, Q, omega=self.omega, state_names=self.state_names, **names)

    def sampled(self, dt):
        """Its samples, as a SampleModel without a forced response."""
        n, step = self.n_states, self.omega * dt
        moved = samples_of(self.coefficients, n, self.omega, step)
        moved = np.concatenate([moved, np.zeros((*moved.shape[:2], 1))], axis=2)
        n_outputs, names = len(self.output_names), (self.input_names, self.output_names)
        no_gain = np.zeros((1, n, n_outputs)), np.eye(n_outputs)
        innovations = PeriodicInnovations(moved, *no_gain, step)
        known = {"state_names": self.state_names, "n_harmonics": len(self.coefficients) // 2}
        direct = bool(self.matrices()[3].any())
        return SampleModel(innovations, self.omega, dt, *names, direct, **known)

    def time_invariant(self, basis):
        """Harmonic decomposition between the coefficients that a basis keeps (Eq. 8).

        A, B, C, D and the names of the states. Where the outputs are the states, the coefficients
        kept are the states, too.
        """
        N, states = self._states_kept(basis)
        labels = harmonic_names(self.state_names, N)
        stacked = _decompose(self.coefficients, self.omega, basis, N, states)
        return parts_of(stacked, len(states)), tuple(labels[i] for i in states)

    def decomposed_structure(self, structure, basis):
        """The same as an AffineStructure of the parameters of a structure, whose model this is.

        And which of the parameters stand in it.
        """
        N, states = self._states_kept(basis)
        shape = structure.constant.shape
        rates = [
            _decompose(row.reshape(shape), 0.0, basis, N, states)
            for row in structure.basis.toarray()
        ]
        seen = np.array([k for k, rate in enumerate(rates) if rate.any()], dtype=int)
        constant = _decompose(structure.constant, self.omega, basis, N, states)
        stacked = np.array([rates[k] for k in seen]).reshape(len(seen), *constant.shape)
        names = tuple(structure.parameter_names[k] for k in seen)
        return AffineStructure(constant, stacked, len(states), names), seen

    def _states_kept(self, basis):
        """Harmonics of the states, and the places of those kept."""
        L = highest_harmonic(basis.outputs)
        if self.state_names == self.output_names:
            return L, kept_places(basis.outputs)
        N = L + len(trimmed_harmonics(self.matrices()[2])) // 2
        return N, list(range((2 * N + 1) * self.n_states))


def _decompose(coefficients, omega, basis, n_harmonics, states):
    """[A B; C D] of the harmonic decomposition between some states and what a basis keeps."""
    n = coefficients.shape[1] - len(basis.outputs)
    M, L = highest_harmonic(basis.inputs), highest_harmonic(basis.outputs)
    A, B, C, D = harmonic_decomposition(*parts_of(coefficients, n), omega, n_harmonics, M, L)
    rows, columns = kept_places(basis.outputs), kept_places(basis.inputs)
    left = [A[np.ix_(states, states)], C[np.ix_(rows, states)]]
    right = [B[np.ix_(states, columns)], D[np.ix_(rows, columns)]]
    return np.hstack([np.vstack(left), np.vstack(right)])


def kept_places(signals):
    """Places of the coefficients kept of some signals in the order s_0, s_1c, s_1s, …."""
    places = []
    for i, (_, orders) in enumerate(signals):
        for k in orders:
            blocks = (0,) if k == 0 else (2 * k - 1, 2 * k)
            places += [block * len(signals) + i for block in blocks]
    return places


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well the record determines a model: the Cramér-Rao bound at the estimate.

    ``tests`` holds columns of the residual tests of the record fitted; None where a simulation
    overflows, or rows are few. ``doubt`` says what of the model does not stand; None if it stands,
    whatever its residuals are.
    """

    covariance: np.ndarray  # (k, k); infinite and NaN where the record leaves parameters open
    noise_std: np.ndarray  # (l,), of the outputs' noise, in their units
    aic: float
    bic: float
    exponents: np.ndarray  # (n,), eigenvalues or Floquet exponents, 1/s
    exponents_std: np.ndarray  # of the real part + j times that of the imaginary part
    affine: AffineStructure | None = None  # the time-invariant model, of some of the parameters
    seen: np.ndarray | None = None  # which parameters
    dt: float = 0.0  # seconds between samples of that model; 0 in continuous time
    kind: str = "information"  # or "robust": what the covariance is made of
    tests: dict | None = None
    doubt: str | None = None

    def frequency_response(self, theta, frequencies):
        """Response at some frequencies (rad/s) and its standard deviation, (n, l, m) each."""
        points = 1j * check_frequencies(frequencies)
        points = np.exp(points * self.dt) if self.dt else points
        response, slopes = self.affine.response_and_sensitivity(theta[self.seen], points)
        return response, propagate_std(slopes, self.covariance[np.ix_(self.seen, self.seen)])

    def step_response(self, theta, step, count, *, impulse=False):
        """Response in time to a step or an impulse, and its standard deviation, (n, l, m) each.

        Slopes are central differences over 1e-4 standard deviations.
        """
        at, options = theta[self.seen], {"dt": self.dt, "impulse": impulse}
        covariance = self.covariance[np.ix_(self.seen, self.seen)]

        def response(moved):
            return step_response(*self.affine.matrices(moved), step, count, **options)

        std = np.sqrt(np.diag(covariance))
        known = np.isfinite(std) & (std > 0.0)
        reach = 1e-4 * np.where(known, std, np.maximum(np.abs(at), 1.0))
        moves = np.diag(reach)
        slopes = [(response(at + m) - response(at - m)) / (2.0 * m.sum()) for m in moves]
        slopes = np.stack(slopes, axis=-1) if slopes else np.zeros((*response(at).shape, 0))
        return response(at), propagate_std(slopes, covariance)


@dataclass(frozen=True, eq=False)
class Match:
    """A structured model: its parameters, and how it came about.

    ``structure`` says how the parameters make the matrices, for the maximum-likelihood refinement;
    None where every entry is one. ``waveform`` (n_phases, l) is what the trim that was subtracted
    is off by, after maximum likelihood.
    """

    model: LTIModel  # in continuous time; the harmonic decomposition of a periodic one
    names: tuple  # of the parameters
    theta: np.ndarray  # (n_parameters,)
    structure: PeriodicStructure | None
    periodic: PeriodicModel | None = None  # of periodic structures only
    theta_least_squares: np.ndarray | None = None  # the match in the mean square, if not theta
    found: MatchResult | None = None  # what the search in a norm left, if there was one
    n_iter: int = 1
    uncertainty: Uncertainty | None = None  # after maximum likelihood only
    sampled: SampleModel | None = None  # with the forced response, of models of samples only
    waveform: np.ndarray | None = None

    @property
    def theta_std(self):
        """Standard deviations of the parameters; NaN without maximum likelihood."""
        if self.uncertainty is None:
            return np.full(len(self.theta), np.nan)
        return np.sqrt(np.diag(self.uncertainty.covariance))

    def stored(self):
        """The same without what only maximum likelihood needs."""
        return replace(self, structure=None, waveform=None)

    def by(self, found):
        """The same with what a search in a norm left."""
        least_squares = found.theta_least_squares
        return replace(self, theta_least_squares=least_squares, found=found, n_iter=found.n_iter)


def periodic_match(structure, theta, periodic, model, basis, found=None):
    """The match of a periodic structure; its time-invariant model is the decomposition."""
    matrices, state_names = periodic.time_invariant(basis)
    names = coefficient_names(basis.inputs), coefficient_names(basis.outputs)
    signals = {"input_names": names[0], "output_names": names[1]}
    matched = model.in_continuous_time(*matrices, state_names=state_names, **signals)
    match = Match(matched, structure.parameter_names, theta, structure, periodic)
    return match if found is None else match.by(found)
