"""Realizations of known F(ψ) and P(ψ): G(ψ) and Q(ψ) by linear least squares on the raw record."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import linalg, sparse

from sklearn_hd._data import lifted_periods
from sklearn_hd._free_response import MAX_GROWTH, GrowthError
from sklearn_hd._periodic import PeriodicModel
from sklearn_hd.algorithms.floquet_coordinates import fixed_scale
from sklearn_hd.algorithms.nested_least_squares import NestedLeastSquares
from sklearn_hd.algorithms.periodic_structure import (
    PeriodicStructure,
    SampledResponse,
    held_pushes,
    sampled_response,
)
from sklearn_hd.algorithms.sensitivity import linear_response
from sklearn_hd.algorithms.structured_model import column_sizes

__all__ = ["InputProblem", "Realization"]

N_INPUT_HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
ROUNDING = 1e-28
RANK = 1e-11  # singular values relative to the largest; dependent periods have 1e-15
LARGEST_FIT = 4e7  # numbers in one regressor matrix


@dataclass(frozen=True, eq=False)
class Realization:
    """A periodic model in closed form, and how far it can be trusted.

    Attributes
    ----------
    model : PeriodicModel
    structure : PeriodicStructure
        Whose parameters the model's coefficients are.
    theta : ndarray
    physical : bool
        Whether the states are outputs, rather than Floquet coordinates.
    r2 : float
        Share of the raw record's variance that the model explains.
    systematic : float
        Share of it that stands unexplained and is no white noise: covariance of what is
        left of neighbouring samples.
    unidentified : tuple of str
        Parameters of G and Q that the record does not determine.
    """

    model: PeriodicModel
    structure: PeriodicStructure
    theta: np.ndarray
    physical: bool
    r2: float
    systematic: float
    unidentified: tuple


@dataclass(frozen=True, eq=False)
class _Fit:
    """Least squares with some number of harmonics of G."""

    count: int
    bic: float
    gains: np.ndarray
    unknown: np.ndarray
    shares: tuple  # of the variance: explained, and systematic


class InputProblem:
    """G(ψ) and Q(ψ) of a system of known F and P, by linear least squares on the raw record.

    Each segment is simulated from an initial state of its own; where the states at the
    beginning of each period are known (``starts``, in any coordinates), each period from its.
    """

    def __init__(self, structure, states, experiment, free, form, scale, starts=None):
        basis = experiment.basis
        self.structure, self.free, self.form = structure, free, form
        self.names = states, tuple(s for s, _ in basis.inputs), tuple(s for s, _ in basis.outputs)
        self.experiment, self.scale, self.simulated = experiment, scale, starts is None
        self.n_rows = sum(map(len, experiment.outputs))
        self.beyond = np.zeros(len(scale))  # left whatever G and Q are, sum of squares
        self.total = sum(float(np.sum((y / scale) ** 2)) for y in experiment.outputs)
        self.parts = self._segments() if starts is None else self._periods(np.vstack(starts))

    def solve(self, n_harmonics, physical):
        """The realization with as many harmonics of G as the data show (Schwarz's criterion).

        And as they determine: inputs that change at a few phases of the period tell more
        harmonics apart only where the outputs are the states.
        """
        counts = self._counts()
        linear = self._known_states(self._resolved(n_harmonics, counts[0]))
        best, worse, fit, further = None, 0, *self._begun(linear, counts)
        for count in counts:
            if best is not None:
                fit.extend(next(further))
            found = self._judged(fit, linear, count)
            if best is not None and np.sum(found.unknown) > np.sum(best.unknown):
                break
            worse = 0 if best is None or found.bic < best.bic else worse + 1
            best = found if worse == 0 else best
            if worse == 2:
                break
        return self._realization(best, n_harmonics, counts[0], physical)

    def _counts(self):
        """Numbers of harmonics of G to be tried."""
        asked = self.structure.n_harmonics("G")
        if asked is not None:
            return [asked]
        highest = (self.experiment.basis.samples_per_period - 1) // 2
        n, m, n_starts = len(self.names[0]), len(self.names[1]), self.parts[0][3].shape[1]
        n_rows = sum(y.size for _, y, _, _ in self.parts)
        first, *others = N_INPUT_HARMONICS
        return [first] + [
            count
            for count in others
            if count <= highest and n_rows * ((2 * count + 1) * n * m + n_starts) <= LARGEST_FIT
        ]

    def _segments(self):
        """Whole segments, each from a state that is unknown."""
        experiment, n = self.experiment, len(self.names[0])
        parts = []
        for s, time in enumerate(experiment.times()):
            own = np.zeros((len(experiment.inputs), n, n))
            own[s] = np.eye(n)
            phase = experiment.basis.phase_index(time)
            parts.append((experiment.inputs[s], experiment.outputs[s], phase, np.hstack(own)))
        return parts

    def _periods(self, starts):
        """Periods, each from its state times a matrix that is unknown, all in as few as do.

        All begin at ψ = 0, so that linear combinations of them are periods, too: of inputs
        and states Z = U S Vᵀ, no more than the rows of S Vᵀ, and of Uᵀ times the outputs.
        """
        experiment, spp = self.experiment, self.experiment.basis.samples_per_period
        inputs, outputs = (
            np.vstack(lifted_periods(experiment, signals))
            for signals in (experiment.inputs, experiment.outputs)
        )
        if experiment.basis.output_trim is not None:  # what it is off by repeats itself
            inputs, outputs, starts = (
                each - each.mean(axis=0) for each in (inputs, outputs, starts)
            )
        states = starts / column_sizes(starts)
        Z = np.hstack([inputs.reshape(len(inputs), -1), states])
        U, sizes, Vt = linalg.svd(Z / column_sizes(Z), full_matrices=False)
        kept = sizes > RANK * sizes[0]
        U, few = U[:, kept], (sizes[kept, None] * Vt[kept]) * column_sizes(Z)
        flat = outputs.reshape(len(outputs), -1)
        seen = U.T @ flat
        left = (flat - U @ seen).reshape(outputs.shape) / self.scale
        self.n_rows, self.beyond = left[..., 0].size, np.sum(left**2, axis=(0, 1))
        self.total = float(np.sum((outputs / self.scale) ** 2))
        n, phase = states.shape[1], np.arange(spp)
        u, y = few[:, :-n].reshape(-1, *inputs.shape[1:]), seen.reshape(-1, *outputs.shape[1:])
        own = [np.kron(np.eye(n), x) for x in few[:, -n:]]
        return list(zip(u, y, [phase] * len(u), own, strict=True))

    def _resolved(self, n_harmonics, count):
        """The structure with some number of harmonics of G."""
        return self.structure.resolve(*self.names, {**n_harmonics, "G": count}, form=self.form)

    def _known_states(self, full):
        """The structure with F and P as found (as near as it allows), G and Q left free."""
        n = full.n_states
        guess = np.zeros(full.constant.shape)
        for name, part in (("F", guess[:, :n, :n]), ("P", guess[:, n:, :n])):
            part[: len(self.free[name])] = self.free[name][: len(part)]
        constant = full.constant.copy()
        constant[:, :, :n] = full.coefficients(full.nearest(guess))[:, :, :n]
        columns = np.unravel_index(np.arange(constant.size), constant.shape)[2]
        entries = sparse.csr_array(full.basis * (columns >= n))  # not F's that share a name
        entries.eliminate_zeros()
        drives = np.diff(entries.indptr) > 0
        names = tuple(np.array(full.parameter_names, dtype=object)[drives])
        return PeriodicStructure(constant, entries[drives], n, names)

    def _begun(self, linear, counts):
        """Least squares by initial states and the parameters of a structure, and an iterator of
        columns for the harmonics of G that further counts add."""
        spp = self.experiment.basis.samples_per_period
        response = sampled_response(linear, np.zeros(linear.n_parameters), self.omega, spp)
        self._check_growth(response)
        forced, left, free = self._columns(response)
        fit = NestedLeastSquares(left)
        fit.extend(np.hstack([free, forced]))
        return fit, self._further_columns(linear, response, counts)

    def _further_columns(self, linear, response, counts):
        n, m = linear.n_states, linear.n_inputs
        spp, theta = self.experiment.basis.samples_per_period, np.zeros(linear.n_parameters)
        Psi = np.broadcast_to(response.Psi, (spp, n, n + m))
        if len(counts) > 1:
            pushes = held_pushes(linear, theta, self.omega, spp, counts[-1])
        for before, count in pairwise(counts):
            new = pushes[2 * before + 1 : 2 * count + 1].transpose(0, 3, 1, 2)
            dPsi = np.zeros((len(new), n, m, spp, n, n + m))
            for j in range(m):
                dPsi[:, :, j, :, :, n + j] = new
            dPsi = dPsi.reshape(-1, spp, n, n + m)
            yield self._columns(SampledResponse(Psi, response.Out, dPsi))[0]

    def _columns(self, response):
        """Outputs by the parameters, what parameters of zero leave of them, and outputs by the
        initial states, in parts of their scale, (n_rows, …)."""
        blocks = []
        for u, y, phase, starts in self.parts:
            forced, given, free = linear_response(response, u, phase)
            free = np.tensordot(starts.T, free, 1)
            each = forced, (y - given)[None], free
            blocks.append([(part / self.scale).reshape(len(part), y.size) for part in each])
        forced, left, free = (np.hstack(parts).T for parts in zip(*blocks, strict=True))
        return forced, left[:, 0], free

    def _judged(self, fit, linear, count):
        """Least squares with some number of harmonics of G, and Schwarz's criterion."""
        solution, left, unknown = fit.solve()
        left, n_starts = left.reshape(-1, len(self.scale)), self.parts[0][3].shape[1]
        n_rows, rss = self.n_rows, np.sum(left**2, axis=0) + self.beyond
        likelihood = n_rows * float(np.sum(np.log(np.maximum(rss, ROUNDING * n_rows))))
        bic = likelihood + np.log(n_rows * len(rss)) * (len(solution) - n_starts)
        # from its predictor's states, what a period leaves is no white noise in any case
        alike = float(np.sum(left[1:] * left[:-1])) if self.simulated else 0.0
        shares = 1.0 - float(np.sum(rss)) / self.total, alike / self.total
        return _Fit(count, bic, solution[n_starts:], unknown[n_starts:], shares)

    def _realization(self, fit, n_harmonics, first, physical):
        """What a fit found, harmonics of G beyond the first count taken for what they are."""
        full = self._resolved(n_harmonics, fit.count)
        linear, basis = self._known_states(full), self.experiment.basis
        places = linear.basis.indices[linear.basis.indptr[:-1]]
        harmonic, row, _ = np.unravel_index(places, linear.constant.shape)
        later = (harmonic > 2 * first) & (row < linear.n_states) & (first < fit.count)
        order = np.lexsort((np.where(later, places, 0), later))  # as in the columns
        gains, unknown = np.empty(len(order)), np.empty(len(order), dtype=bool)
        gains[order], unknown[order] = fit.gains, fit.unknown
        found = linear.coefficients(gains)
        theta = full.nearest(found)
        model = PeriodicModel(full.coefficients(theta), basis.omega, *self.names)
        if self.form is not None:
            full, theta = fixed_scale(full, theta, self.form)
        names = tuple(np.array(linear.parameter_names, dtype=object)[unknown])
        return Realization(model, full, theta, physical, *fit.shares, names)

    def _check_growth(self, response):
        periods = max(len(phase) for _, _, phase, _ in self.parts) / max(len(response.Phi), 1)
        growth = periods * np.log(max(response.spectral_radius, 1e-300))
        if not growth <= MAX_GROWTH:
            raise GrowthError(
                f"F(ψ) of the states {list(self.names[0])} with the harmonics allowed makes a "
                f"model that grows e^{growth:.0f} times over the record; allow more harmonics of "
                f"F, sample more often, or change the order of the model"
            )

    @property
    def omega(self):
        return self.experiment.basis.omega
