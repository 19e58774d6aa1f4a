"""Arguments of systems and simulations: names, records, periodic matrices.

``PeriodicSystem``, ``LTPSystem`` and the others of this room need it.
"""

import numpy as np

from sklearn_hd._checks import real_array
from sklearn_hd._containers import from_elsewhere, is_pandas
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics, resize_harmonics
from sklearn_hd.algorithms.periodic.harmonic_decomposition import fourier_coefficients
from sklearn_hd.algorithms.signals.fourier import harmonic_labels


class NamedSignals:
    """Counts of the states, inputs and outputs that a system names."""

    @property
    def n_states(self):
        """Number n of states."""
        return len(self.state_names)

    @property
    def n_inputs(self):
        """Number m of inputs."""
        return len(self.input_names)

    @property
    def n_outputs(self):
        """Number l of outputs."""
        return len(self.output_names)

    def _names(self):
        """Names by the parameter that gives them."""
        return {
            "state_names": self.state_names,
            "input_names": self.input_names,
            "output_names": self.output_names,
        }

    def _described(self, which):
        """The system in one line, ``which`` its frequency or period."""
        return (
            f"{type(self).__name__}({which}, states={list(self.state_names)}, "
            f"inputs={list(self.input_names)}, outputs={list(self.output_names)})"
        )


def check_names(names, parameter, count=None, letter=None):
    """Names as a tuple, by default x1, x2, …; as many as there are signals, all different."""
    if names is None and letter is not None:
        return tuple(f"{letter}{k + 1}" for k in range(count))
    given = (names,) if isinstance(names, str) else names
    if not np.iterable(given) or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"{parameter}={names!r} must name each signal in text, as ['w', 'phi_dot'] does"
        )
    given = tuple(given)
    count = len(given) if count is None else count
    if len(given) != count or len(set(given)) != count:
        raise ValueError(
            f"{parameter}={list(given)} must hold {count} different names, one for each signal"
        )
    return given


def harmonic_names(names, n_harmonics):
    """Names of harmonics in the paper's order: all signals' 0, then 1c, 1s, ….

    Examples
    --------
    >>> harmonic_names(["w", "phi_dot"], 1)
    ['w_0', 'phi_dot_0', 'w_1c', 'phi_dot_1c', 'w_1s', 'phi_dot_1s']
    """
    labels = harmonic_labels(range(n_harmonics + 1))
    return [f"{name}_{label}" for label in labels for name in names]


def check_times(t):
    """Sample times as an increasing array of at least two."""
    wanted = "two or more finite, increasing times in seconds"
    t = real_array("t", t, wanted)
    if t.ndim != 1 or len(t) < 2 or not np.all(np.diff(t) > 0):
        raise ValueError(
            f"t of shape {t.shape} must be one-dimensional, with {wanted}; sort it and drop "
            f"repeated times"
        )
    return t


def in_order(what, data, axis, names):
    """A table in the order of some names, if any of these label it; others as they are."""
    data = from_elsewhere(data, what)
    named = is_pandas(data) and (axis == "columns" or data.ndim == 1)
    labels = list(getattr(data, axis, ())) if named else []
    if not set(labels) & set(names):
        return data
    if sorted(map(str, labels)) != sorted(names):
        raise ValueError(
            f"{what} has the {axis} {labels}, but {list(names)} are needed: give these, in any "
            f"order, or an array in this order"
        )
    return data[list(names)]


def check_inputs(u, n_samples, names, *, batch=True):
    """Inputs as an array (n_samples, m), or (..., n_samples, m) where records may be stacked."""
    m, u = len(names), in_order("u", u, "columns", names)
    u = real_array("u", u, f"{n_samples} values of each of {list(names)}, finite: inputs are held")
    if u.ndim == 1 and m == 1:
        u = u[:, None]
    if u.ndim < 2 or (u.ndim > 2 and not batch) or u.shape[-2:] != (n_samples, m):
        raise ValueError(
            f"u has shape {u.shape}; with {n_samples} times in t and the inputs {list(names)} it "
            f"must have shape ({n_samples}, {m})"
        )
    return u


def check_state(x0, batch, names):
    """Initial state as an array (..., n), zero by default."""
    if x0 is None:
        return np.zeros((*batch, len(names)))
    x0 = in_order("x0", x0, "index", names)
    x0 = real_array("x0", x0, f"one finite value for each of the states {list(names)}")
    if x0.shape not in ((len(names),), (*batch, len(names))):
        raise ValueError(
            f"x0 has shape {x0.shape}; it must hold one value for each of the states {list(names)}"
        )
    return np.broadcast_to(x0, (*batch, len(names)))


class FourierMatrix:
    """Periodic matrix M(ψ) = M_0 + Σ_k (M_kc cos kψ + M_ks sin kψ).

    Parameters
    ----------
    coefficients : array_like, shape (2 K + 1, rows, columns)
        Real coefficients in the order 0, 1c, 1s, ….

    Raises
    ------
    ValueError
        If the coefficients are of another shape, or not finite.

    References
    ----------
    Hayajnh, Saetti, Prasad (2024), Aerospace 11(11), 875, Eq. 9.

    Examples
    --------
    >>> M = FourierMatrix(np.array([1.0, 0.5, 0.0]).reshape(3, 1, 1))
    >>> M(np.array([0.0, np.pi])).ravel().tolist()
    [1.5, 0.5]
    >>> M.n_harmonics
    1
    """

    def __init__(self, coefficients):
        wanted = "an array of shape (2 K + 1, rows, columns) in the order 0, 1c, 1s, …"
        self.coefficients = np.array(real_array("coefficients", coefficients, wanted))
        if self.coefficients.ndim != 3 or len(self.coefficients) % 2 == 0:
            raise ValueError(
                f"Fourier coefficients have shape {self.coefficients.shape}; give {wanted}"
            )

    @property
    def n_harmonics(self):
        """K, the highest harmonic."""
        return len(self.coefficients) // 2

    def __call__(self, psi):
        """Values at azimuths psi, shape (n_points,) -> (n_points, rows, columns)."""
        return evaluate_harmonics(self.coefficients, psi)

    def __repr__(self):
        return f"FourierMatrix(shape={self.coefficients.shape})"


def periodic_matrix(matrix, name):
    """Callable of ψ and the shape of its value."""
    if not callable(matrix):
        wanted = (
            "a matrix (rows, columns), Fourier coefficients (2 K + 1, rows, columns), or a "
            "callable of psi"
        )
        values = real_array(name, matrix, wanted)
        if values.ndim not in (2, 3):
            raise ValueError(f"{name} has shape {values.shape}; give {wanted}")
        matrix = FourierMatrix(values[None] if values.ndim == 2 else values)
    try:
        shape = np.shape(matrix(np.zeros(2)))
    except (TypeError, ValueError) as error:
        raise ValueError(
            f"{name} fails for two azimuths at once ({error}); a callable of psi with shape "
            f"(n_points,) must return (n_points, rows, columns): for one of a single azimuth give "
            f"lambda psi: np.array([{name}(p) for p in psi])"
        ) from error
    if len(shape) != 3 or shape[0] != 2:
        raise ValueError(
            f"{name} returned an array of shape {shape} for two azimuths; a callable of psi with "
            f"shape (n_points,) must return (n_points, rows, columns)"
        )
    return matrix, shape[1:]


def matrix_coefficients(matrix, n_harmonics):
    if isinstance(matrix, FourierMatrix):
        return resize_harmonics(matrix.coefficients, n_harmonics)
    tolerance = max(1e-13, precision(matrix))
    return fourier_coefficients(matrix, n_harmonics, tolerance=tolerance)


def precision(*matrices):
    """Relative error of matrices: rounding, or what one of them states (differences do)."""
    return max(1e-14, *(getattr(matrix, "precision", 0.0) for matrix in matrices))


def measure(matrix, signals, psi):
    """M(ψ_k) s_k for each sample, the samples taken in blocks."""
    if isinstance(matrix, FourierMatrix) and len(matrix.coefficients) == 1:
        return signals @ matrix.coefficients[0].T
    blocks = [
        np.einsum("kij,...kj->...ki", matrix(psi[k : k + 4096]), signals[..., k : k + 4096, :])
        for k in range(0, len(psi), 4096)
    ]
    return np.concatenate(blocks, axis=-2)
