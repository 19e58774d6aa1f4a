"""Linear time-periodic models: a value that travels, and its simulation sample by sample."""

from dataclasses import dataclass

import numpy as np

from sklearn_hd._frame import highest_harmonic
from sklearn_hd.algorithms.floquet import harmonic_decomposition, propagate_periodic
from sklearn_hd.algorithms.fourier import harmonic_labels
from sklearn_hd.algorithms.periodic_structure import PeriodicStructure, sampled_response
from sklearn_hd.algorithms.structured_model import AffineStructure
from sklearn_hd.systems import LTPSystem


@dataclass(frozen=True, eq=False)
class PeriodicModel:
    """Linear time-periodic system by its Fourier coefficients, as a value that pickles.

    Attributes
    ----------
    coefficients : ndarray, shape (2 K + 1, n + l, n + m)
        Of [F G; P Q](ψ), in the order 0, 1c, 1s, ….
    omega : float
        rad/s.
    state_names, input_names, output_names : tuple of str
    """

    coefficients: np.ndarray
    omega: float
    state_names: tuple
    input_names: tuple
    output_names: tuple

    @property
    def n_states(self):
        """Number of states."""
        return len(self.state_names)

    def matrices(self):
        """Fourier coefficients of F, G, P and Q."""
        M, n = self.coefficients, self.n_states
        return M[:, :n, :n], M[:, :n, n:], M[:, n:, :n], M[:, n:, n:]

    def to_system(self):
        """The model as an LTPSystem."""
        F, G, P, Q = (_trimmed(M) for M in self.matrices())
        return LTPSystem(
            F,
            G,
            P,
            Q,
            omega=self.omega,
            state_names=self.state_names,
            input_names=self.input_names,
            output_names=self.output_names,
        )

    def sampled(self, n_phases):
        """Transition and output matrices of the samples of one period."""
        fixed = PeriodicStructure(
            self.coefficients, np.zeros((0, self.coefficients.size)), self.n_states, ()
        )
        return sampled_response(fixed, [], self.omega, n_phases, sensitivities=False)

    def time_invariant(self, basis):
        """Harmonic decomposition between the coefficients that a basis keeps (Eq. 8).

        Where the outputs are the states, the coefficients kept are the states, too.

        Returns
        -------
        A, B, C, D : ndarray
        state_names : tuple of str
        """
        M, L = highest_harmonic(basis.inputs), highest_harmonic(basis.outputs)
        F, G, P, Q = self.matrices()
        measured = self.state_names == self.output_names
        N = L if measured else L + len(_trimmed(P)) // 2
        A, B, C, D = harmonic_decomposition(F, G, P, Q, self.omega, N, M, L)
        rows, columns = kept_places(basis.outputs), kept_places(basis.inputs)
        labels = [
            f"{name}_{label}"
            for label in harmonic_labels(range(N + 1))
            for name in self.state_names
        ]
        states = rows if measured else range(len(A))
        A, B = A[np.ix_(states, states)], B[np.ix_(states, columns)]
        C, D = C[np.ix_(rows, states)], D[np.ix_(rows, columns)]
        return (A, B, C, D), tuple(labels[i] for i in states)


def _trimmed(coefficients):
    """Fourier coefficients without harmonics that are zero."""
    moving = np.flatnonzero(np.any(coefficients != 0.0, axis=(1, 2)))
    highest = (moving[-1] + 1) // 2 if len(moving) else 0
    return coefficients[: 2 * highest + 1]


def kept_places(signals):
    """Places of the coefficients kept of some signals in the order s_0, s_1c, s_1s, …."""
    places = []
    for i, (_, orders) in enumerate(signals):
        for k in orders:
            blocks = (0,) if k == 0 else (2 * k - 1, 2 * k)
            places += [block * len(signals) + i for block in blocks]
    return places


class PeriodicSimulator:
    """Free simulation of a periodic model over one segment, linear in its initial state.

    Parameters
    ----------
    model : PeriodicModel
    response : SampledResponse
        Of the model, over the samples of one period.
    phase : ndarray of int, shape (n_samples,)
        Sample within the period.
    inputs : ndarray, shape (n_samples, m)
    time : ndarray, shape (n_samples,)
    """

    def __init__(self, model, response, phase, inputs, time):
        self.model, self.time, self.inputs, self.phase = model, time, inputs, phase
        self.response = response

    def outputs(self, x0, *, recompose=True):
        """Outputs, trim not added, shape (n_samples, n_outputs)."""
        states = self._states(self.inputs, x0)
        extended = np.concatenate([states, self.inputs], axis=-1)
        return np.einsum("tla,ta->tl", self._at(self.response.Out), extended)

    def free(self, n_samples):
        """Outputs of the first samples for each unit initial state, (n, n_samples, n_outputs)."""
        n = self.model.n_states
        states = self._states(np.zeros((n_samples, self.inputs.shape[1])), np.eye(n))
        return np.einsum("tla,kta->ktl", self._at(self.response.Out)[:n_samples, :, :n], states)

    def _at(self, matrices):
        return matrices[self.phase % len(matrices)]

    def _states(self, inputs, x0):
        n = self.model.n_states
        Psi = self.response.Psi
        turned = np.roll(Psi, -(self.phase[0] % len(Psi)), axis=0)
        which = np.arange(len(inputs)) % len(Psi)
        forcing = np.einsum("tij,tj->ti", turned[which, :, n:], inputs)
        forcing = np.broadcast_to(forcing, (*x0.shape[:-1], *forcing.shape))
        return propagate_periodic(turned[:, :, :n], forcing, x0)


def decomposed_structure(structure, basis):
    """The harmonic decomposition of a periodic structure, between the coefficients kept.

    Parameters
    ----------
    structure : PeriodicStructure
        Its outputs are its states.
    basis : HarmonicBasis

    Returns
    -------
    affine : AffineStructure
    seen : ndarray of int
        Parameters that stand in it.
    """
    n, shape = structure.n_states, structure.constant.shape
    M, N = highest_harmonic(basis.inputs), highest_harmonic(basis.outputs)
    rows, columns = kept_places(basis.outputs), kept_places(basis.inputs)

    def decompose(coefficients, omega):
        parts = coefficients[:, :n, :n], coefficients[:, :n, n:]
        parts += coefficients[:, n:, :n], coefficients[:, n:, n:]
        A, B, C, D = harmonic_decomposition(*parts, omega, N, M, N)
        return np.block(
            [
                [A[np.ix_(rows, rows)], B[np.ix_(rows, columns)]],
                [C[np.ix_(rows, rows)], D[np.ix_(rows, columns)]],
            ]
        )

    rates = [decompose(row.reshape(shape), 0.0) for row in structure.basis.toarray()]
    seen = np.array([k for k, rate in enumerate(rates) if rate.any()], dtype=int)
    stacked = np.array([rates[k] for k in seen]).reshape(len(seen), *_stacked_shape(rows, columns))
    names = tuple(structure.parameter_names[k] for k in seen)
    constant = decompose(structure.constant, basis.omega)
    return AffineStructure(constant, stacked, len(rows), names), seen


def _stacked_shape(rows, columns):
    return 2 * len(rows), len(rows) + len(columns)
