"""Realizations of known F(ψ) and P(ψ): G(ψ) and Q(ψ) by linear least squares on the raw record.

Inputs that change at few phases of the period leave combinations of G's harmonics open, or nearly
so. Of all G that explain the record, the one wanted changes least over the period: its entries are
smoothing splines,

    min Σ |y − ŷ(G, Q, x0)|² + σ²/τ² Σ_ij s_ij² ∫ (dG_ij/dψ)² dψ/π,

s_ij being the size of what a constant push makes of the record. Coefficients of harmonic k so have
the prior N(0, τ²/(k s_ij)²); constants, Q and x0 are free. σ²/τ² and the number of harmonics
maximise the marginal likelihood (Wahba 1985), in which as many rows count as what no G explains
has independent ones, and one for what each direction of the inputs makes of each state. Further
harmonics, of Q too, have to be worth the logarithm of that number for each parameter. Where the
record determines G, exact data give it exactly: σ² is rounding.

G. Wahba, "A comparison of GCV and GML for choosing the smoothing parameter in the generalized
spline smoothing problem", Annals of Statistics 13 (1985), 1378-1402.
C. J. Geyer, "Practical Markov chain Monte Carlo", Statistical Science 7 (1992), 473-483.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import fft, linalg, sparse

from sklearn_hd._match import PeriodicModel
from sklearn_hd._records.data import lifted_periods
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, EXACT, UNKNOWN
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.periodic.behind_samples import at_every_phase
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
    radius_of,
    sampled_response,
)
from sklearn_hd.algorithms.signals.fourier import InputDirections

MAX_GROWTH = 100.0  # e-folds over a record
N_INPUT_HARMONICS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
PATIENCE = 2  # numbers of harmonics that are no better before a search ends
LARGEST_FIT = 4e7  # numbers in one regressor matrix


class GrowthError(ValueError):
    """A model that grows more over a record than numbers can hold."""


@dataclass(frozen=True, eq=False)
class Realization:
    """A periodic model in closed form, and how far it can be trusted.

    ``systematic`` is the share of the raw record's variance that stands unexplained and is no
    white noise: covariance of what is left of neighbouring samples.
    """

    model: PeriodicModel
    structure: PeriodicStructure  # whose parameters the model's coefficients are
    theta: np.ndarray
    physical: bool  # states are outputs, rather than Floquet coordinates
    r2: float  # share of the raw record's variance that the model explains
    systematic: float
    unidentified: tuple  # names of parameters of G and Q that the record does not determine
    without: float | None = None  # what was systematic without Q, where the data asked for one


@dataclass(frozen=True, eq=False)
class _Fit:
    """The smoothest fit with some number of harmonics of G."""

    count: int
    misfit: float
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
        moved = InputDirections.of([u[:, None] for u in experiment.inputs]).moved
        self.n_idle = len(states) * (moved.shape[0] - moved.shape[1])
        turns = [u for u in lifted_periods(experiment, experiment.inputs) if len(u)]
        self.n_told = len(states) * InputDirections.of(turns).moved.shape[1] if turns else 0
        self.total = sum(float(np.sum((y / scale) ** 2)) for y in experiment.outputs)

    def solve(self, n_harmonics, physical, feedthrough=False):
        """The realization with the smoothest G, and as many harmonics of G as the data show.

        With a feedthrough also as many of Q as are worth their parameters, if any.
        """
        found, misfit = self._solved(n_harmonics, physical)
        if not feedthrough:
            return found
        without, worse = found.systematic, 0
        price = np.log(self._n_independent()) * len(self.names[1]) * len(self.names[2])
        for count in self._counts():
            other, cost = self._solved({**n_harmonics, "Q": count}, physical)
            cost += (2 * count + 1) * price
            worse = 0 if cost < misfit else worse + 1
            if worse == 0:
                found, misfit = replace(other, without=without), cost
            if worse == PATIENCE or 1.0 - found.r2 <= EXACT:  # rounding is left
                break
        return found

    def _solved(self, n_harmonics, physical):
        """A realization with some number of harmonics of Q, and its marginal likelihood.

        With as many harmonics of G as the data determine: inputs that change at a few phases of
        the period tell more harmonics apart only where the outputs are the states.
        """
        asked = self.structure.n_harmonics("G")
        first = N_INPUT_HARMONICS[0] if asked is None else asked
        linear = self._known_states(self._resolved(n_harmonics, first))
        response, n = self._sampled(linear), linear.n_states
        self.parts = self._segments(response) if self.starts is None else self._periods()
        counts = [first] if asked is not None else self._counts()
        theta, spp = np.zeros(linear.n_parameters), len(response.Psi)
        pushes = held_pushes(linear, theta, self.omega, spp, counts[-1])
        unit = np.eye(linear.n_inputs)

        def pushed(some):  # columns of each harmonic, of each state, by each input
            gains = np.einsum("hpba,jc->hajpbc", pushes[some], unit)
            return self._columns(response, gains.reshape(-1, spp, n, len(unit)))[0]

        forced, left, free = self._columns(response, response.dPsi[..., n:], response.dOut[..., n:])
        fit, sizes = NestedLeastSquares(left), column_sizes(pushed(slice(1))).reshape(n, -1)
        fit.extend(np.hstack([free, forced]))
        weights = np.zeros(linear.constant.shape)
        weights[:, :n, n:] = np.multiply.outer((np.arange(len(weights)) + 1) // 2, sizes)
        stiffness = np.append(np.zeros(free.shape[1]), weights.ravel()[_places(linear)])
        tried, worse = [], 0
        for before, count in zip([None, *counts], counts, strict=False):
            if before is not None:
                later = np.arange(2 * before + 1, 2 * count + 1)
                fit.extend(pushed(later))
                stiffness = np.append(stiffness, np.multiply.outer((later + 1) // 2, sizes))
            found = self._judged(fit, count, stiffness)
            if tried and found.n_unknown > tried[-1].n_unknown:
                break
            least = min((each.misfit for each in tried), default=np.inf)
            worse = 0 if found.misfit < least else worse + 1
            tried.append(found)
            if worse == PATIENCE:
                break
        price = np.log(self._n_independent())  # of a parameter: more have to be worth one
        enough = min(each.misfit for each in tried) + price
        fewest = next(each for each in tried if each.misfit <= enough)
        return self._realization(fewest, n_harmonics, counts[0], physical), fewest.misfit

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
            n_samples = spp
        radius = radius_of(response.monodromy)
        growth = n_samples / len(response.Phi) * np.log(max(radius, 1e-300))
        if not growth <= MAX_GROWTH:
            raise GrowthError(
                f"F(ψ) of the states {list(self.names[0])} with the allowed harmonics makes a "
                f"model that grows e^{growth:.0f} times over the record; allow more harmonics of "
                f"F, sample more often, or change the order of the model"
            )
        each = response.Psi, response.Out, response.dPsi, response.dOut
        return SampledResponse(*(at_every_phase(M, spp) for M in each))

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
        rests = [rest.reshape(-1, len(self.scale))[:length] for _, rest, length in self.folded]
        self.beyond = np.concatenate(rests)
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
        kept = sizes > DEPENDENT * sizes[0]
        U, few = U[:, kept], (sizes[kept, None] * Vt[kept]) * column_sizes(Z)
        flat = outputs.reshape(len(outputs), -1)
        seen = U.T @ flat
        left = (flat - U @ seen).reshape(outputs.shape) / self.scale
        self.beyond = left.reshape(-1, len(self.scale))
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

    def _judged(self, fit, count, stiffness):
        """The smoothest fit with some number of harmonics of G, and its marginal likelihood."""
        n_starts, beyond = self.parts[0].starts.shape[2], float(np.sum(self.beyond**2))
        solution, left, misfit = fit.solve(stiffness, beyond, self._n_independent())
        open_ = fit.undetermined
        unknown = np.linalg.norm(open_, axis=0)[n_starts:] > UNKNOWN
        n_unknown = len(open_) - self.n_idle * (2 * count + 1)  # but for inputs that never part
        rss = float(np.sum(left**2)) + beyond
        return _Fit(count, misfit, solution[n_starts:], unknown, n_unknown, rss, left)

    def _n_independent(self):
        """Independent rows: those of what no G explains, and what inputs make of the states.

        Of the former as many as give a mean the same variance: their number over 1 + 2 Σ ρ_k, ρ
        their autocorrelation while it lasts (Geyer 1992). All rows where what no G explains is
        rounding.
        """
        rows = self.beyond
        if float(np.sum(rows**2)) <= EXACT**2 * self.total:
            return rows.size
        spectrum = np.abs(fft.rfft(rows, 2 * len(rows), axis=0)) ** 2
        covariance = fft.irfft(spectrum.sum(axis=1))[: len(rows) // 2 * 2]
        pairs = covariance.reshape(-1, 2).sum(axis=1) / covariance[0]
        lasting = np.argmax(pairs <= 0.0) or len(pairs)
        alone = len(rows) / max(1.0, 2.0 * pairs[:lasting].sum() - 1.0)
        return min(alone * len(self.scale) + self.n_told, rows.size)

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
        linear = self._known_states(full)
        places = _places(linear)
        harmonic, row, _ = np.unravel_index(places, linear.constant.shape)
        later = (harmonic > 2 * first) & (row < linear.n_states)
        order = np.lexsort((np.where(later, places, 0), later))  # as in the columns
        gains, unknown = np.empty(len(order)), np.empty(len(order), dtype=bool)
        gains[order], unknown[order] = fit.gains, fit.unknown
        found = linear.coefficients(gains)
        theta = full.nearest(found)
        model = PeriodicModel(full.coefficients(theta), self.omega, *self.names)
        if self.form is not None:
            full, theta = fixed_scale(full, theta, self.form)
        names = tuple(np.array(linear.parameter_names, dtype=object)[unknown])
        shares = 1.0 - fit.rss / self.total, self._systematic(fit.left) / self.total
        return Realization(model, full, theta, physical, *shares, names)


def _places(structure):
    """Where each parameter's first entry stands among all coefficients."""
    return structure.basis.indices[structure.basis.indptr[:-1]]
