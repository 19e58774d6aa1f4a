"""Mode shapes of the outputs, from the raw periods of a record.

The Poincaré map Φ and what every sample of the period sees of the state. Of a model
identified in open loop, Φ is refined on the raw record, on which the model is simulated; of
one identified in closed loop, the states are those of its predictor.
"""

import numpy as np
from scipy import linalg

from sklearn_hd._records.data import beside_trim, lifted_periods, rows_read
from sklearn_hd.algorithms.periodic.multipliers import refine_multipliers
from sklearn_hd.algorithms.periodic.periodic_realization import (
    fit_shapes,
    floquet_logarithm,
    leaves_white_noise,
    response_to_states,
    state_response,
    told_apart,
)
from sklearn_hd.algorithms.signals.lifting import input_directions
from sklearn_hd.algorithms.subspace.innovations import predicted_states

__all__ = ["GrowthError", "most_directions", "output_shapes", "predictor_states"]

MAX_GROWTH = 100.0  # e-folds over a record
LEAST_DECAY = 4  # periods for each state in a free decay that can stand alone
REST_SHARE = 1e-9  # of an input's largest value, below which it is at rest
A_TENTH_LESS = 0.9  # left by the multipliers identified, in parts of that by the refined ones


class GrowthError(ValueError):
    """A model that grows more over a record than numbers can hold."""


def output_shapes(model, experiment, scale, states=None):
    """Mode shapes of the outputs, in parts of their scale.

    Parameters
    ----------
    model : LTIModel
        Discrete, from one period to the next.
    experiment : Experiment
    scale : ndarray, shape (n_outputs,)
    states : list of ndarray, shapes (n_periods_s, n), optional
        At the beginning of each period, from :func:`predictor_states`; else simulated.

    Returns
    -------
    shapes : FloquetShapes

    Raises
    ------
    FloquetError, GrowthError
        If the multipliers are those of no periodic system, or of one that outgrows numbers.
    """
    basis = experiment.basis
    spp, period = basis.samples_per_period, 2.0 * np.pi / basis.omega
    inputs = lifted_periods(experiment, experiment.inputs)
    lifted = [y.reshape(len(y), -1) for y in lifted_periods(experiment, experiment.outputs, scale)]
    directions, _, _ = input_directions(
        inputs, most_directions(sum(map(len, lifted)), model.n_states)
    )
    _, seen = rows_read(experiment)
    if states is None:
        unit = _sizes(np.vstack(seen))
        C, seen = model.C / unit[:, None], [Y / unit for Y in seen]
        Phi, response, n_rows = _simulated(model.A, C, inputs, directions, lifted, seen)
    else:
        directions = beside_trim(directions, basis)
        Phi, response = model.A, response_to_states(states, directions, lifted)
        n_rows = sum(map(len, lifted)) - directions[0].shape[1] - model.n_states
    sights, information, residual = response
    R, to_original, flips = floquet_logarithm(Phi, period)
    back = linalg.inv(to_original)
    sights = sights.reshape(spp, -1, model.n_states) @ to_original
    return fit_shapes(
        sights,
        back @ information @ back.T,
        residual.reshape(spp, -1),
        R,
        flips,
        period,
        n_rows,
    )


def predictor_states(model, experiment):
    """States of a model with a Kalman gain at the beginning of each period, by its predictor.

    Its predictor is stable, and its errors are independent of inputs that answer to outputs of
    earlier periods.

    Returns
    -------
    states : list of ndarray, shapes (n_periods_s, n)
    """
    inputs = lifted_periods(experiment, experiment.inputs)
    directions, _, _ = input_directions(
        inputs, most_directions(sum(map(len, inputs)), model.n_states)
    )
    _, seen = rows_read(experiment)
    unit = _sizes(np.vstack(seen))
    C, K, seen = model.C / unit[:, None], model.kalman_gain * unit, [Y / unit for Y in seen]
    return predicted_states(model.A, C, K, beside_trim(directions, experiment.basis), seen)


def _simulated(A, C, inputs, directions, lifted, seen):
    """Φ refined on the raw record, what it sees of the states, and the rows left for noise."""
    n, n_periods = len(A), sum(map(len, lifted))
    Phi = refine_multipliers(A, directions, lifted)
    Phi = _unless_it_explains_less(Phi, A, C, directions, lifted, seen)
    radius = max(np.max(np.abs(linalg.eigvals(Phi))), np.finfo(float).tiny)
    growth = max(map(len, lifted)) * np.log(radius)
    if growth > MAX_GROWTH:
        raise GrowthError(
            f"a mode of the identified model grows e^{growth:.0f} times over the record, more than "
            f"a record can show: lower the order, check omega, or cut the record shorter"
        )
    if not leaves_white_noise(Phi, directions, lifted):
        # systematic errors, a nonlinear system's: smallest where the motion dies away
        free = free_decays(inputs)
        decays = [lifted[s][rows] for s, rows in free]
        if sum(map(len, decays)) > LEAST_DECAY * n and told_apart(Phi, decays):
            lifted, seen = ([blocks[s][rows] for s, rows in free] for blocks in (lifted, seen))
            directions = [np.zeros((len(block), 0)) for block in lifted]
            Phi = refine_multipliers(Phi, directions, lifted)
            n_periods = sum(map(len, lifted))
    response = state_response(Phi, C, directions, lifted, seen)
    return Phi, response, n_periods - directions[0].shape[1] - n


def _unless_it_explains_less(refined, identified, C, directions, lifted, seen):
    """The refined map, or the identified one where that leaves a tenth less of the record.

    Multipliers are refined with every mode free to answer in its own way to each direction of
    the inputs. Many modes that last but a period or two can then stand for each other, and noise
    decides; with one B for all that is seen they cannot.
    """
    left, others = (
        np.sum(state_response(Phi, C, directions, lifted, seen)[2]) for Phi in (refined, identified)
    )
    return identified if others < A_TENTH_LESS * left else refined


def free_decays(inputs):
    """Periods of each segment after the last in which an input moves: (segment, rows)."""
    largest = np.max(np.abs(np.concatenate(inputs)), axis=(0, 1), initial=0.0)
    tails = []
    for s, u in enumerate(inputs):
        moving = np.flatnonzero(np.any(np.abs(u) > REST_SHARE * largest, axis=(1, 2)))
        tails.append((s, slice(moving[-1] + 1 if len(moving) else 0, len(u))))
    return [(s, rows) for s, rows in tails if len(inputs[s][rows])]


def most_directions(n_periods, n_states):
    """Directions of the inputs that some periods can tell from the states."""
    return max(1, n_periods // 2 - n_states)


def _sizes(columns):
    sizes = np.sqrt(np.mean(columns**2, axis=0))
    return np.where(sizes > 0.0, sizes, 1.0)
