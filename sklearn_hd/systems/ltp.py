"""Linear time-periodic systems (Eq. 6) and their harmonic decomposition (Eq. 8)."""

import control
import numpy as np
import pandas as pd
from scipy import linalg
from scipy.optimize import linear_sum_assignment

from sklearn_hd._checks import check_count, check_flag, check_numbers, check_positive
from sklearn_hd._guards import within_range
from sklearn_hd.algorithms.periodic import floquet
from sklearn_hd.algorithms.periodic import harmonic_decomposition as hd
from sklearn_hd.algorithms.signals.fourier import times_near_zero_phase
from sklearn_hd.systems.arguments import (
    NamedSignals,
    check_inputs,
    check_names,
    check_state,
    check_times,
    harmonic_names,
    matrix_coefficients,
    measure,
    periodic_matrix,
    precision,
)
from sklearn_hd.systems.export import export_model
from sklearn_hd.systems.harmonic_transfer import model_response
from sklearn_hd.systems.minimal import harmonic_modes, minimal_model, read_decomposition


class LTPSystem(NamedSignals):
    """Linear system with coefficients of period T = 2π / ω.

        ẋ = F(ψ) x + G(ψ) u,   y = P(ψ) x + Q(ψ) u,   ψ = ωt              (Eq. 6)

    Parameters
    ----------
    F, G, P, Q : callable, or array_like
        A callable of ψ (radians), shape (n_points,) -> (n_points, rows, columns); a
        constant matrix (rows, columns); or real Fourier coefficients
        (2 K + 1, rows, columns) in the order 0, 1c, 1s, …. A matrix may jump within
        the period. F is (n, n), G (n, m), P (l, n), Q (l, m). P=None measures the
        states, Q=None means no feedthrough.
    omega : float
        Fundamental frequency in rad/s.
    state_names, input_names, output_names : sequence of str, optional
        By default x1, x2, …, u1, …, y1, …; with P=None the outputs are named after
        the states.

    Attributes
    ----------
    n_states, n_inputs, n_outputs : int
    period : float
        T in seconds.

    Raises
    ------
    ValueError
        If omega is not positive, shapes and names do not fit, or a number is not finite.

    References
    ----------
    Aerospace 2024, 11(11), 875, Eqs. 6 to 9.

    Examples
    --------
    A parametrically excited mass whose damping keeps it stable:

    >>> F = np.zeros((3, 2, 2))
    >>> F[0] = [[0.0, 1.0], [-1.0, -0.4]]
    >>> F[1] = [[0.0, 0.0], [-0.2, 0.0]]
    >>> system = LTPSystem(F, [[0.0], [1.0]], omega=3.0, state_names=["q", "q_dot"])
    >>> bool(np.isclose(system.floquet_exponents().sum().real, -0.4))
    True
    >>> hd = system.harmonic_decomposition(1)
    >>> hd.state_labels
    ['q_0', 'q_dot_0', 'q_1c', 'q_dot_1c', 'q_1s', 'q_dot_1s']
    """

    def __init__(
        self, F, G, P=None, Q=None, *, omega, state_names=None, input_names=None, output_names=None
    ):
        self.omega = check_positive("omega", omega, "rad/s", "it is 2π over the period in seconds")
        self.F, (n, columns) = periodic_matrix(F, "F")
        self.G, (rows, m) = periodic_matrix(G, "G")
        if n != columns or rows != n:
            raise ValueError(
                f"F is {n} x {columns} and G is {rows} x {m}; F must be square, with as many "
                f"rows as G"
            )
        measures_states = P is None
        self.P, (n_outputs, columns) = periodic_matrix(np.eye(n) if P is None else P, "P")
        self.Q, shape = periodic_matrix(np.zeros((n_outputs, m)) if Q is None else Q, "Q")
        if columns != n or shape != (n_outputs, m):
            raise ValueError(
                f"P is {n_outputs} x {columns} and Q is {shape[0]} x {shape[1]}; with {n} states "
                f"and {m} inputs, P must have {n} columns and Q as many rows as P and {m} columns"
            )
        self.state_names = check_names(state_names, "state_names", n, "x")
        self.input_names = check_names(input_names, "input_names", m, "u")
        if output_names is None and measures_states:
            output_names = self.state_names
        self.output_names = check_names(output_names, "output_names", n_outputs, "y")

    @classmethod
    @within_range
    def from_harmonic_decomposition(
        cls, model, omega, *, state_names=None, input_names=None, output_names=None, tolerance=0.1
    ):
        """Periodic system whose harmonic decomposition is a given model.

            F, G, P, Q = arg min ‖[A + ωN, B; C, D] − [T(F), T(G); T(P), T(Q)]‖

        This is the inverse of :meth:`harmonic_decomposition`. It returns the Fourier coefficients
        of F up to harmonic 2 N, of G up to N + M, of P up to L + N and of Q up to L + M.

        Parameters
        ----------
        model : control.StateSpace
            Continuous. Its labels (w_0, w_1c, …) name the signal and harmonic of each state, input
            and output, in any order; harmonics may differ by signal.
        omega : float
            Fundamental frequency in rad/s.
        state_names, input_names, output_names : sequence of str, optional
            Signals, if the labels do not name them; coefficients are then in the paper's order
            (all signals' harmonic 0, then 1c, 1s, …).
        tolerance : float, default=0.1
            Share of a matrix (Frobenius norm, units of the signals scaled out) that the
            nearest such pattern may leave.

        Returns
        -------
        system : LTPSystem
            Its matrices are Fourier series.

        Raises
        ------
        ValueError
            If more than ``tolerance`` is left, labels are not understood, the model is
            discrete, or the harmonics kept leave a coefficient undetermined.

        Warns
        -----
        IdentifiabilityWarning
            If more than rounding is left; the model has this form only approximately. The warning
            states the share.
        """
        names = {"state_names": state_names, "input_names": input_names}
        names["output_names"] = output_names
        matrices, names = read_decomposition(model, omega, names, tolerance)
        return cls(*matrices, omega=omega, **names)

    @property
    def period(self):
        """Period T = 2π / ω in seconds."""
        return 2.0 * np.pi / self.omega

    def __repr__(self):
        return self._described(f"omega={self.omega:.6g}")

    @within_range
    def fourier_coefficients(self, n_harmonics):
        """Real Fourier coefficients of F, G, P and Q up to some harmonic.

        Parameters
        ----------
        n_harmonics : int
            K, the highest harmonic.

        Returns
        -------
        F, G, P, Q : ndarray, shapes (2 K + 1, rows, columns)
            In the order 0, 1c, 1s, …; jumps within the period cost no accuracy.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is negative or not whole.
        """
        K = _check_harmonics("n_harmonics", n_harmonics)
        return tuple(matrix_coefficients(M, K) for M in (self.F, self.G, self.P, self.Q))

    @within_range
    def monodromy(self, start=0.0):
        """Transition matrix Φ over one period.

            x(t + T) = Φ x(t)   for u = 0,   ψ(t) = start

        Parameters
        ----------
        start : float, default=0.0
            Azimuth ψ at which the period begins, radians.

        Returns
        -------
        monodromy : ndarray, shape (n_states, n_states)
            Its eigenvalues are the Floquet multipliers e^{λT}, whatever ``start``.

        Raises
        ------
        ValueError
            If ``start`` is not finite.
        """
        check_numbers("finite", "it is the azimuth ψ in radians", start=start)
        tolerance = precision(self.F)
        return floquet.monodromy_matrix(self.F, self.omega, start=start, tolerance=tolerance)

    @within_range
    def floquet_exponents(self):
        """Exponents λ of the solutions p(ψ) e^{λt}, p periodic.

        Known only up to multiples of jω; returned with imaginary part in
        (−ω/2, ω/2], from the rightmost leftwards, conjugate pairs with the negative
        imaginary part first.

        Returns
        -------
        exponents : complex ndarray, shape (n_states,)
            In 1/s. They are also correct if multipliers e^{λT} differ by a hundred decades, which
            :meth:`monodromy` cannot represent.

        Raises
        ------
        ValueError
            If F exceeds the range of floating-point numbers.
        """
        return floquet.floquet_exponents(self.F, self.omega, tolerance=precision(self.F))

    @within_range
    def harmonic_decomposition(self, n_harmonics, n_input_harmonics=None, n_output_harmonics=None):
        """Time-invariant model of the harmonics of the states (Eqs. 8 and 9).

        Parameters
        ----------
        n_harmonics : int
            N, harmonics kept of the states.
        n_input_harmonics, n_output_harmonics : int, optional
            M and L, harmonics kept of inputs and outputs; N by default.

        Returns
        -------
        model : control.StateSpace
            Continuous, with n (2N + 1) states. All signals' harmonic 0 come first,
            then their 1c, 1s, 2c, …; names are w_0, phi_dot_0, w_1c, ….

        Raises
        ------
        ValueError
            If a number of harmonics is negative or not whole.
        """
        N = _check_harmonics("n_harmonics", n_harmonics)
        M = N if n_input_harmonics is None else n_input_harmonics
        L = N if n_output_harmonics is None else n_output_harmonics
        M = _check_harmonics("n_input_harmonics", M)
        L = _check_harmonics("n_output_harmonics", L)
        coefficients = self.fourier_coefficients(max(2 * N, N + M, L + N, L + M))
        A, B, C, D = hd.harmonic_decomposition(*coefficients, self.omega, N, M, L)
        return control.StateSpace(
            A,
            B,
            C,
            D,
            states=harmonic_names(self.state_names, N),
            inputs=harmonic_names(self.input_names, M),
            outputs=harmonic_names(self.output_names, L),
        )

    @within_range
    def harmonic_transfer_function(
        self,
        frequencies,
        n_harmonics,
        *,
        sample_time=None,
        tolerance=1e-8,
        max_internal_harmonics=128,
    ):
        """Response to u e^{jΩt}, harmonic by harmonic.

            y(t) = Σ_n H_n(jΩ) u e^{j(Ω + nω)t}

        It is computed from T(P) (jΩ I + N − T(F))⁻¹ T(G) + T(Q), the Toeplitz form of the harmonic
        decomposition. Internal harmonics are doubled until the result no longer changes.

        Parameters
        ----------
        frequencies : array_like, shape (n_frequencies,)
            Ω in rad/s.
        n_harmonics : int
            N, harmonics of the outputs.
        sample_time : float, optional
            Seconds. Gives the response from sample to sample for inputs held between samples, as
            :meth:`simulate` holds them; compare records of such inputs with it. It is exact, also
            for matrices that jump. A period must hold a whole number of samples.
        tolerance : float, default=1e-8
            Largest change on doubling the internal harmonics, relative to the largest value.
        max_internal_harmonics : int, default=128
            Bound on the internal harmonics; a ConvergenceWarning states the remaining change.

        Returns
        -------
        response : HarmonicTransferFunction
            With ``response`` H_n(jΩ).

        Raises
        ------
        ValueError
            If a parameter is out of its range, or a period does not hold a whole number of
            samples.

        References
        ----------
        N. M. Wereley, S. R. Hall, "Frequency response of linear time periodic
        systems", 29th IEEE Conference on Decision and Control (1990).

        Examples
        --------
        >>> system = LTPSystem([[-1.0]], [[1.0]], omega=5.0)
        >>> response = system.harmonic_transfer_function([0.0, 1.0], 1)
        >>> response.harmonic(0).ravel().round(12).tolist()
        [(1+0j), (0.5-0.5j)]
        """
        N = _check_harmonics("n_harmonics", n_harmonics)
        check_numbers("positive", "1e-8 is usual", tolerance=tolerance)
        return model_response(self, frequencies, N, sample_time, tolerance, max_internal_harmonics)

    @within_range
    def modal_participation(self, n_harmonics):
        """Share of each harmonic of a state in that state's motion in each Floquet mode.

        The mode p(ψ) e^{λt}, p = Σ_k c_k e^{jkψ}, moves state i by the harmonics
        c_ik; the shares

            (|c_ik| + |c_{i,−k}|) / Σ_k |c_ik|

        sum to one for each state and mode, or to zero if the mode does not move the state. Each
        Floquet exponent is represented by the eigenvalue of the HD model nearest to it (the
        paper's base eigenvalues, Fig. 1).

        Parameters
        ----------
        n_harmonics : int
            Harmonics kept of the states.

        Returns
        -------
        shares : DataFrame, n (N + 1) rows by n modes
            Index: (state, harmonic); columns: eigenvalues of the HD model in 1/s, in
            the order of :meth:`floquet_exponents`.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is negative or not whole.

        References
        ----------
        D. A. Peters, S. M. Lieb, "Significance of Floquet Eigenvalues and
        Eigenvectors for the Dynamics of Time-Varying Systems", American Helicopter
        Society Forum 65 (2009).
        """
        N, n = _check_harmonics("n_harmonics", n_harmonics), self.n_states
        F = matrix_coefficients(self.F, 2 * N)
        A = hd.toeplitz_matrix(F, N, N) - hd.derivative_matrix(N, n, self.omega)
        eigenvalues, vectors = linalg.eig(A)
        distance = np.abs(self.floquet_exponents()[:, None] - eigenvalues)
        base = linear_sum_assignment(distance)[1]
        sizes = hd.harmonic_sizes(vectors[:, base].reshape(2 * N + 1, n, n))
        total = sizes.sum(axis=0)  # none where a mode does not move a state
        shares = np.divide(sizes, total, out=np.zeros_like(sizes), where=total > 0.0)
        index = pd.MultiIndex.from_product(
            [self.state_names, range(N + 1)], names=["state", "harmonic"]
        )
        values = np.swapaxes(shares, 0, 1).reshape(-1, n)
        return pd.DataFrame(values, index, pd.Index(eigenvalues[base], name="eigenvalue"))

    @within_range
    def harmonic_modes(self, n_harmonics):
        """Modes of the harmonic decomposition: copies, and their links to u_0 and y_0.

            λ + jkω,   k = −N … N,   of which k = 0 is the base mode

        The base mode is the continuation of a mode of the mean of F.

        Parameters
        ----------
        n_harmonics : int
            N, the number of copies on either side.

        Returns
        -------
        modes : DataFrame
            ``eigenvalue`` and that of its ``base`` mode in 1/s; ``copy``, k;
            ``controllability``, from u_0, and ``observability``, in y_0: the harmonic that belongs
            to this copy, as a share of the largest of the mode, from 0 to 1. A negative multiplier
            has two base modes, σ ± jω/2.

        Raises
        ------
        ValueError
            If ``n_harmonics`` is negative or not whole.

        Warns
        -----
        ConvergenceWarning
            If eigenvalues of the decomposition do not reach the Floquet exponents.

        Examples
        --------
        >>> system = LTPSystem([[-1.0]], [[1.0]], omega=5.0)
        >>> system.harmonic_modes(1)[["copy", "controllability"]].to_numpy().tolist()
        [[0.0, 1.0], [-1.0, 0.0], [1.0, 0.0]]
        """
        return harmonic_modes(self, _check_harmonics("n_harmonics", n_harmonics))

    @within_range
    def minimal_model(self, n_copies=0, n_output_harmonics=0, *, return_loss=False):
        """Controllable and observable time-invariant model for controller design.

            ẋ = A x + B u_0,   Y = C x + D u_0

        The harmonic decomposition has n (2 N + 1) states. An ordered Schur form separates the base
        modes from their copies. The omitted copies act at once, by their steady response in D
        (residualization). Modes that u_0 does not reach, or Y does not show, are omitted, too.

        Parameters
        ----------
        n_copies : int, default=0
            K: copies λ ± jω … λ ± jKω are kept. The model needs them if its inputs act, or its
            outputs see, mostly by harmonics.
        n_output_harmonics : int, default=0
            L, harmonics of the outputs.
        return_loss : bool, default=False
            Whether to return also the loss.

        Returns
        -------
        model : control.StateSpace
            Continuous. Its states are means of states, w_0, …, if as many of them determine its
            modes; otherwise modal, z1, z2, …. A gain K of u_0 = −K x then is also one of u = −K
            x(t) on these states, except for the ripple within a period. Check it by the exponents
            of the closed loop, ``LTPSystem(F - G K, …)``.
        loss : float
            Only with ``return_loss=True``: what the model misses, in parts of the response of an
            output (with its harmonics) to an input, rms over frequencies up to ω/2 or the fastest
            mode; worst pair.

        Raises
        ------
        ValueError
            If a parameter is out of its range, or a base mode and a copy have the same eigenvalue.

        Warns
        -----
        IdentifiabilityWarning
            For each omitted mode that u_0 does not reach or Y does not show, with its exponent; if
            the loss exceeds 0.1.
        ConvergenceWarning
            As :meth:`harmonic_modes`.

        References
        ----------
        Lopez, Prasad (2017), J. American Helicopter Society 62 (decomposition);
        Kokotović, Khalil, O'Reilly (1999), Singular Perturbation Methods in Control.

        Examples
        --------
        >>> F = np.zeros((3, 2, 2))
        >>> F[0], F[1, 1, 0] = [[0.0, 1.0], [-1.0, -0.2]], -0.3
        >>> system = LTPSystem(F, [[0.0], [1.0]], omega=6.0, state_names=["q", "v"])
        >>> model = system.minimal_model()
        >>> model.nstates, model.state_labels
        (2, ['q_0', 'v_0'])
        >>> gain, _, poles = control.lqr(model, np.eye(2), [[1.0]])
        >>> F[0] -= [[0.0], [1.0]] @ gain
        >>> closed = LTPSystem(F, [[0.0], [1.0]], omega=6.0).floquet_exponents()
        >>> bool(np.allclose(np.sort(closed.real), np.sort(poles.real), rtol=0.02))
        True
        """
        check_flag("return_loss", return_loss)
        check_count("n_copies", n_copies, 0, "0 keeps the base modes alone")
        L = _check_harmonics("n_output_harmonics", n_output_harmonics)
        model, loss = minimal_model(self, n_copies, L)
        return (model, loss) if return_loss else model

    @within_range
    def simulate(self, u, t, x0=None, *, return_states=False):
        """Outputs at the sample times, exact for inputs held between samples.

        If the samples repeat after a period, the transition matrices of one period are used for
        the whole record; otherwise each interval has its own.

        Parameters
        ----------
        u : array_like, shape (n_samples,), (n_samples, m) or (..., n_samples, m)
            Inputs; ``u[k]`` acts from ``t[k]`` to ``t[k + 1]``. Leading axes are
            further records on the same times. Columns of a DataFrame that are names of
            the inputs go by these.
        t : array_like, shape (n_samples,)
            Increasing times in seconds; ψ = ωt.
        x0 : array_like, shape (n,) or (..., n), optional
            State at ``t[0]``; zero by default. A Series goes by the names of the states.
        return_states : bool, default=False
            Whether to return the states too.

        Returns
        -------
        y : ndarray, shape (..., n_samples, l)
            Outputs.
        x : ndarray, shape (..., n_samples, n)
            Only with ``return_states=True``.

        Raises
        ------
        ValueError
            If shapes do not fit, t does not increase, or a value is not finite.
        """
        check_flag("return_states", return_states)
        t = check_times(t)
        u = check_inputs(u, len(t), self.input_names)
        x0 = check_state(x0, u.shape[:-2], self.state_names)
        psi = self.omega * times_near_zero_phase(t, self.omega)
        intervals = psi[: floquet.intervals_of_a_period(psi) + 1]
        Phi, Gamma = self._transition_matrices(intervals)
        which = np.arange(len(t)) % len(Phi)
        forcing = np.einsum("kij,...kj->...ki", Gamma[which], u)
        x = floquet.propagate_periodic(Phi, forcing, x0)
        y = measure(self.P, x, psi) + measure(self.Q, u, psi)
        return (y, x) if return_states else y

    def _transition_matrices(self, psi):
        """Φ and Γ from each azimuth to the next, as exactly as F and G were given."""
        tolerance = precision(self.F, self.G)
        return floquet.transition_matrices(self.F, self.G, psi, self.omega, tolerance=tolerance)

    def export(self, path, *, n_phases=64):
        """Write the system to a file, as :func:`export_model` does.

        Parameters
        ----------
        path : str or path-like
            Ends in ``.json`` (:func:`load_model` reads it) or ``.mat`` (for MATLAB).
        n_phases : int, default=64
            Number of azimuths per period at which the matrices are also tabulated.
        """
        export_model(self, path, n_phases=n_phases)


def _check_harmonics(name, value):
    return check_count(name, value, 0, "0 keeps the mean alone")
