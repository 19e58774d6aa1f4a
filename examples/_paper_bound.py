"""The Cramér-Rao bound on the error of ``reproduce_paper.py``: what noise alone must cost."""

import numpy as np

from sklearn_hd import HarmonicStructure
from sklearn_hd.algorithms.likelihood.forms import Form
from sklearn_hd.algorithms.likelihood.uncertainty import fisher_information, propagate_std
from sklearn_hd.algorithms.lti.simulation import continuous_to_discrete, propagate
from sklearn_hd.algorithms.signals.fourier import recompose
from sklearn_hd.systems import LTPSystem

STEP = 1e-20  # of the complex-step derivatives, exact to rounding


def bound_percent(data, snr, free_inputs=3):
    """Bound on the rms of e (percent) of unbiased estimates of A from this noisy record.

    White Gaussian noise of 1/snr of each output's standard deviation, known, on the outputs;
    the input and x0 = 0 are known. With J the derivatives of the three-state heave model's
    whitened outputs with respect to the nine entries of A and those of B that are free,

        rms e ≥ (tr [(JᵀJ)⁻¹]_A)^½ / ‖A‖_F.

    Parameters
    ----------
    data : Bunch
        From ``make_flapping_wing``, subsystem heave; three outputs are the coefficients
        themselves, two are w and φ̇ (Eq. 7).
    snr : float
    free_inputs : {1, 3}, default=3
        Entries of B to be estimated: all, or the only one that is not zero.
    """
    A, B = data.A_exact.to_numpy(), data.B_exact.to_numpy()
    inputs = data.inputs_clean.to_numpy()
    psi = data.omega * data.inputs.index.to_numpy()
    sigma = data.outputs_clean.to_numpy().std(axis=0) / snr
    free = [(i, j) for i in range(3) for j in range(3)]
    free += [(1, 3)] if free_inputs == 1 else [(i, 3) for i in range(3)]

    def outputs(theta):
        discrete = continuous_to_discrete(theta[:, :3], theta[:, 3:], data.sample_time)
        x = propagate(discrete[0], inputs @ discrete[1].T, np.zeros(3))
        if len(sigma) == 3:
            return x / sigma
        return np.column_stack([x[:, 0], recompose(x[:, 1:], psi, [1])]) / sigma

    J = []
    for entry in free:
        theta = np.hstack([A, B]).astype(complex)
        theta[entry] += 1j * STEP
        J.append(outputs(theta).imag.ravel() / STEP)
    J = np.column_stack(J)
    size = np.linalg.norm(J, axis=0)
    R = np.linalg.qr(J / size, mode="r")
    deviation = np.linalg.norm(np.linalg.inv(R), axis=1) / size
    return 100.0 * np.linalg.norm(deviation[: A.size]) / np.linalg.norm(A)


def periodic_bound_percent(data, snr, n_harmonics=(4, 1)):
    """The same for a periodic model with some harmonics of F and G, all entries free, x0 too.

    Parameters
    ----------
    data : Bunch
    snr : float
    n_harmonics : (int, int), default=(4, 1)
        Of F(ψ) and G(ψ): those that the noisy records of the example mostly ask for.
    """
    names, samples = ["w", "phi_dot"], round(2 * np.pi / data.omega / data.sample_time)
    counts = dict(zip("FG", n_harmonics, strict=True))
    structure = HarmonicStructure().resolve(names, ["U"], names, counts)
    F, G, _, _ = data.ltp.fourier_coefficients(n_harmonics[0])
    exact = np.zeros(structure.constant.shape)
    exact[:, :2, :2], exact[0, 2:, :2] = F, np.eye(2)
    exact[: 2 * n_harmonics[1] + 1, :2, 2:] = G[: 2 * n_harmonics[1] + 1]
    basis = structure.basis.toarray()
    theta = np.linalg.lstsq(basis.T, (exact - structure.constant).ravel())[0]
    sigma = data.outputs_clean.to_numpy().std(axis=0) / snr
    record = [(data.inputs_clean.to_numpy(), data.outputs_clean.to_numpy(), 0)]
    found = fisher_information(Form(structure, data.omega, samples), theta, record, sigma)

    def heave(coefficients):
        hd = LTPSystem(coefficients[:, :2, :2], np.zeros((2, 1)), omega=data.omega)
        return hd.harmonic_decomposition(1).A[np.ix_([0, 3, 5], [0, 3, 5])].ravel()

    at = heave(structure.constant)
    slopes = [heave(structure.constant + row.reshape(exact.shape)) - at for row in basis]
    deviation = propagate_std(np.transpose(slopes), found.covariance)
    return 100.0 * np.linalg.norm(deviation) / np.linalg.norm(data.A_exact)
