"""States, inputs and outputs of a system by name, and records of them as users give them."""

import numpy as np

from sklearn_hd._checks import real_array


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


def check_inputs(u, n_samples, names, *, batch=True):
    """Inputs as an array (n_samples, m), or (..., n_samples, m) where records may be stacked."""
    m = len(names)
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
    x0 = real_array("x0", x0, f"one finite value for each of the states {list(names)}")
    if x0.shape not in ((len(names),), (*batch, len(names))):
        raise ValueError(
            f"x0 has shape {x0.shape}; it must hold one value for each of the states {list(names)}"
        )
    return np.broadcast_to(x0, (*batch, len(names)))
