"""Realizations of known F(ψ) and P(ψ): G(ψ) and Q(ψ) by linear least squares on the raw record."""

from dataclasses import dataclass, replace

import numpy as np
from scipy import linalg, sparse

from sklearn_hd._match.match import PeriodicModel
from sklearn_hd._records.data import lifted_periods
from sklearn_hd.algorithms.lti.structured_model import column_sizes
from sklearn_hd.algorithms.periodic.combined_periods import (
    CombinedPeriods,
    NestedLeastSquares,
    combined_periods,
)
from sklearn_hd.algorithms.periodic.floquet_coordinates import fixed_scale
from sklearn_hd.algorithms.periodic.periodic_structure import (
    PeriodicStructure,
    SampledResponse,
    held_pushes,
    sampled_response,
)
from sklearn_hd.algorithms.signals.lifting import InputDirections

MAX_GROWTH = 100.0  # e-folds over a record
N_INPUT_HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
LEAST_SQUARE = 1e-28  # of a row of outputs of unit size: what rounding leaves
RANK = 1e-11  # singular values relative to the largest; dependent periods have 1e-15
LARGEST_FIT = 4e7  # numbers in one regressor matrix


class GrowthError(ValueError):
    """A model that grows more over a record than numbers can hold."""


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
    n_unknown: int
    rss: float
    left: np.ndarray


class InputProblem:
    """G(ψ) and Q(ψ) of a system of known F and P, by linear least squares on the raw record.

    Each segment is simulated from an initial state of its own; where the states at the
    beginning of each period are known (``starts``, in any coordinates), each period from its.
    """

    def __init__(self, structure, states, experiment, free, form, scale, starts=None):
        basis = experiment.basis
        self.structure, self.free, self.form = structure, free, form
        self.omega = basis.omega
        self.names = states, tuple(s for s, _ in basis.inputs), tuple(s for s, _ in basis.outputs)
        self.experiment, self.scale, self.starts = experiment, scale, starts
        self.n_rows = sum(map(len, experiment.outputs))
        moved = InputDirections.of([u[:, None] for u in experiment.inputs]).moved
        self.n_idle = len(states) * (moved.shape[0] - moved.shape[1])
        self.beyond = np.zeros(len(scale))  # left whatever G and Q are, sum of squares
        self.total = sum(float(np.sum((y / scale) ** 2)) for y in experiment.outputs)

    def solve(self, n_harmonics, physical):
        """The realization with as many harmonics of G as the data show (Schwarz's criterion).

        And as they determine: inputs that change at a few phases of the period tell more
        harmonics apart only where the outputs are the states.
        """
        asked = self.structure.n_harmonics("G")
        first = N_INPUT_HARMONICS[0] if asked is None else asked
        linear = self._known_states(self._resolved(n_harmonics, first))
        response, n = self._sampled(linear), linear.n_states
        self.parts = self._segments(response) if self.starts is None else self._periods()
        counts = [first] if asked is not None else self._counts()
        forced, left, free = self._columns(response, response.dPsi[..., n:], response.dOut[..., n:])
        fit = NestedLeastSquares(left)
        fit.extend(np.hstack([free, forced]))
        if len(counts) > 1:
            theta, spp = np.zeros(linear.n_parameters), len(response.Psi)
            pushes = held_pushes(linear, theta, self.omega, spp, counts[-1])
            unit = np.eye(linear.n_inputs)
        best, worse = None, 0
        for before, count in zip([None, *counts], counts, strict=False):
            if before is not None:
                new = pushes[2 * before + 1 : 2 * count + 1]  # of each state, by each input
                gains = np.einsum("hpba,jc->hajpbc", new, unit).reshape(-1, spp, n, len(unit))
                fit.extend(self._columns(response, gains)[0])
            found = self._judged(fit, count)
            if best is not None and found.n_unknown > best.n_unknown:
                break
            worse = 0 if best is None or found.bic < best.bic else worse + 1
            best = found if worse == 0 else best
            if worse == 2:
                break
        return self._realization(best, n_harmonics, counts[0], physical)

    def _counts(self):
        """Numbers of harmonics of G to be tried."""
        first, *others = N_INPUT_HARMONICS
        highest = (self.experiment.basis.samples_per_period - 1) // 2
        n, m = len(self.names[0]), len(self.names[1])
        n_rows = sum(np.sum(part.seen) for part in self.parts) * len(self.scale)
        n_starts = self.parts[0].starts.shape[2]
        return [first] + [
            count
            for count in others
            if count <= highest and n_rows * ((2 * count + 1) * n * m + n_starts) <= LARGEST_FIT
        ]

    def _sampled(self, linear):
        """The response of a structure at all phases, G and Q at zero."""
        spp = self.experiment.basis.samples_per_period
        response = sampled_response(linear, np.zeros(linear.n_parameters), self.omega, spp)
        n_samples = max(map(len, self.experiment.outputs))
        if self.starts is not None:  # each period from its own
            n_samples = self.experiment.basis.samples_per_period
        growth = n_samples / len(response.Phi) * np.log(max(response.spectral_radius, 1e-300))
        if not growth <= MAX_GROWTH:
            raise GrowthError(
                f"F(ψ) of the states {list(self.names[0])} with the allowed harmonics makes a "
                f"model that grows e^{growth:.0f} times over the record; allow more harmonics of "
                f"F, sample more often, or change the order of the model"
            )
        each = response.Psi, response.Out, response.dPsi, response.dOut
        return SampledResponse(
            *(np.broadcast_to(M, (*M.shape[:-3], spp, *M.shape[-2:])) for M in each)
        )

    def _segments(self, response):
        """Whole segments, each from a state that is unknown."""
        experiment, n = self.experiment, len(self.names[0])
        spp, parts, self.folded = experiment.basis.samples_per_period, [], []
        for s, time in enumerate(experiment.times()):
            first = int(experiment.basis.phase_index(time)[0])
            Phi = SampledResponse(np.roll(response.Psi, -first, axis=0), response.Out).monodromy
            u, y = experiment.inputs[s], experiment.outputs[s]
            part, combinations, rest = combined_periods(Phi, u, y, spp, first)
            own = np.zeros((len(experiment.inputs), n, n))
            own[s] = np.eye(n)
            parts.append(replace(part, starts=part.starts @ np.hstack(own)))
            self.folded.append((combinations, rest / self.scale, len(y)))
        self.beyond = sum(np.sum(rest**2, axis=(0, 1)) for _, rest, _ in self.folded)
        return parts

    def _periods(self):
        """Periods, each from its state times a matrix that is unknown, all in as few as do.

        All begin at ψ = 0, so that linear combinations of them are periods, too: of inputs
        and states Z = U S Vᵀ, no more than the rows of S Vᵀ, and of Uᵀ times the outputs.
        """
        experiment, starts = self.experiment, np.vstack(self.starts)
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
        d, n = len(few), states.shape[1]
        return [
            CombinedPeriods(
                few[:, :-n].reshape(-1, *inputs.shape[1:]),
                np.eye(d),
                np.zeros((d, d, n, n)),
                np.stack([np.kron(np.eye(n), x) for x in few[:, -n:]]),
                seen.reshape(-1, *outputs.shape[1:]).transpose(1, 2, 0),
                np.ones((outputs.shape[1], d), dtype=bool),
            )
        ]

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

    def _columns(self, response, gains, direct=None):
        """Outputs by the parameters, what parameters of zero leave of them, and outputs by the
        initial states, in parts of their scale, (n_rows, …)."""
        each = [part.columns(response, gains, direct, self.scale) for part in self.parts]
        return [np.concatenate(blocks) for blocks in zip(*each, strict=True)]

    def _judged(self, fit, count):
        """Least squares with some number of harmonics of G, and Schwarz's criterion."""
        solution, left, unknown = fit.solve()
        n_unknown = fit.n_unknown - self.n_idle * (2 * count + 1)  # but for inputs that never part
        n_starts = self.parts[0].starts.shape[2]
        n_rows, n_outputs = self.n_rows, len(self.scale)
        rss = np.sum(left.reshape(-1, n_outputs) ** 2, axis=0) + self.beyond
        likelihood = n_rows * float(np.sum(np.log(np.maximum(rss, LEAST_SQUARE * n_rows))))
        bic = likelihood + np.log(n_rows * n_outputs) * (len(solution) - n_starts)
        solution, unknown, rest = solution[n_starts:], unknown[n_starts:], float(np.sum(rss))
        return _Fit(count, bic, solution, unknown, n_unknown, rest, left)

    def _systematic(self, left):
        """Covariance of what is left of neighbouring samples, or of neighbouring periods, summed.

        The larger of both: noise repeats itself in neither. From its predictor's states, what a
        period leaves is no white noise in any case.
        """
        if self.starts is not None:
            return 0.0
        edges, samples = np.cumsum([np.sum(part.seen) for part in self.parts])[:-1], []
        blocks = np.split(left.reshape(-1, len(self.scale)), edges)
        for part, (combinations, rest, length), rows in zip(
            self.parts, self.folded, blocks, strict=True
        ):
            whole = rest + np.tensordot(combinations, part.unfolded(rows), (1, 2))
            samples.append(whole.reshape(-1, len(self.scale))[:length])
        samples = np.vstack(samples)
        lags = 1, self.experiment.basis.samples_per_period
        return max(float(np.sum(samples[lag:] * samples[:-lag])) for lag in lags)

    def _realization(self, fit, n_harmonics, first, physical):
        """What a fit found, harmonics of G beyond the first count taken for what they are."""
        full = self._resolved(n_harmonics, fit.count)
        linear, basis = self._known_states(full), self.experiment.basis
        places = linear.basis.indices[linear.basis.indptr[:-1]]
        harmonic, row, _ = np.unravel_index(places, linear.constant.shape)
        later = (harmonic > 2 * first) & (row < linear.n_states)
        order = np.lexsort((np.where(later, places, 0), later))  # as in the columns
        gains, unknown = np.empty(len(order)), np.empty(len(order), dtype=bool)
        gains[order], unknown[order] = fit.gains, fit.unknown
        found = linear.coefficients(gains)
        theta = full.nearest(found)
        model = PeriodicModel(full.coefficients(theta), basis.omega, *self.names)
        if self.form is not None:
            full, theta = fixed_scale(full, theta, self.form)
        names = tuple(np.array(linear.parameter_names, dtype=object)[unknown])
        shares = 1.0 - fit.rss / self.total, self._systematic(fit.left) / self.total
        return Realization(model, full, theta, physical, *shares, names)
