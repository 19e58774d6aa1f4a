"""Jacobians F, G, P, Q of ẋ = f(x, u, t), y = g(x, u, t) along a periodic orbit."""

import numpy as np

__all__ = ["CentralDifferences", "OrbitMatrix", "states_measured"]


def states_measured(F, G):
    """(F, G, P, Q) of a system whose outputs are its states."""
    return F, G, np.broadcast_to(np.eye(F.shape[-1]), F.shape), np.zeros(G.shape)


class OrbitMatrix:
    """One of F, G, P, Q along a trim, as a function of azimuth."""

    def __init__(self, jacobian, trim, which):
        self.jacobian, self.trim, self.which = jacobian, trim, which
        self.precision = getattr(jacobian, "precision", 0.0)

    def __call__(self, psi):
        x = self.trim.states(psi).T
        u = np.broadcast_to(self.trim.inputs[:, None], (len(self.trim.inputs), len(psi)))
        return self.jacobian(x, u, np.asarray(psi) / self.trim.omega)[self.which]


class CentralDifferences:
    """F, G, P, Q by central differences of f and g.

    Steps of ε^{1/3} of the largest size of each variable balance truncation and
    rounding; the result is good to about ``precision``. The sizes are those of the
    points given, or of a whole orbit: a step fitted to a few points where a state
    passes through zero would be lost in rounding.
    """

    precision = 1e-8

    def __init__(self, f, g, sizes=None):
        self.f, self.g, self.sizes = f, g, sizes

    def along(self, trim):
        """The same with steps that fit a whole orbit."""
        psi = 2.0 * np.pi * np.arange(256) / 256
        orbit = np.max(np.abs(trim.states(psi)), axis=0)
        return CentralDifferences(self.f, self.g, (orbit, np.abs(trim.inputs)))

    def __call__(self, x, u, t):
        sizes = self.sizes or [np.max(np.abs(v), axis=1, initial=0.0) for v in (x, u)]
        x_steps, u_steps = (
            np.cbrt(np.finfo(float).eps) * np.where(size > 0, size, 1.0) for size in sizes
        )
        F = _slopes(lambda x: self.f(x, u, t), x, x_steps)
        G = _slopes(lambda u: self.f(x, u, t), u, u_steps)
        if self.g is None:
            return states_measured(F, G)
        P = _slopes(lambda x: self.g(x, u, t), x, x_steps)
        Q = _slopes(lambda u: self.g(x, u, t), u, u_steps)
        return F, G, P, Q


def _slopes(function, variables, steps):
    """Derivatives of function(variables), (l, k), by each of the variables, (m, k)."""
    columns = []
    for i, step in enumerate(steps):
        above, below = np.array(variables), np.array(variables)
        above[i] += step
        below[i] -= step
        columns.append((np.asarray(function(above)) - function(below)) / (2.0 * step))
    if not columns:
        n_rows = len(np.asarray(function(variables)))
        return np.zeros((variables.shape[1], n_rows, 0))
    return np.stack(columns, axis=-1).swapaxes(0, 1)
