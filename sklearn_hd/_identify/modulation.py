"""Inputs as a sliding window sees them, for the projection of the future outputs.

The response of a periodic system, seen through a sliding window, depends on the phase of the
period. Its coefficients at the analysed rows are time-invariant

- to u itself, where u changes at one phase of the period alone;
- to u, u cos pψ, u sin pψ, …, except for what u does within a hop (Wereley, 1990);
- to the samples of u within each hop, times what tells the rows of a period apart:
  exactly, for whatever moves within one hop is in w, and the response to w at row k,

      Ŷ[k] = Σ_d H_d(k − d) w[k − d],   H_d(k) = H_d(k + r),

  is time-invariant to the r parts of w that are other than zero at one phase of r.
"""

import numpy as np

from sklearn_hd.algorithms.signals.fourier import harmonic_functions
from sklearn_hd.algorithms.signals.lifting import input_directions
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns

__all__ = [
    "changes_at_one_phase",
    "inputs_by_phase",
    "largest_changes",
    "modulated",
    "modulated_inputs",
    "n_modulating_harmonics",
    "steps_at_one_phase",
]

STEP_SHARE = 0.25  # of an input's largest change, below which one is no step, but maybe noise


def changes_at_one_phase(experiment):
    """Whether all steps of the inputs fall on one sample of the period."""
    changes = [
        largest_changes(experiment.basis, drive, time)
        for drive, time in zip(experiment.drive, experiment.times(), strict=True)
    ]
    return steps_at_one_phase(np.max(changes, axis=0))


def largest_changes(basis, drive, time):
    """Largest change of each input from one sample to the next, by the phase of the latter.

    Returns
    -------
    changes : ndarray, shape (samples_per_period, m)
    """
    changes = np.zeros((basis.samples_per_period, drive.shape[1]))
    np.maximum.at(changes, basis.phase_index(time)[1:], np.abs(np.diff(drive, axis=0)))
    return changes


def steps_at_one_phase(changes):
    """Whether the largest changes at each phase hold steps at one phase alone."""
    steps = (changes > STEP_SHARE * np.max(changes, axis=0)) & (changes > 0.0)
    return int(np.sum(np.any(steps, axis=1))) <= 1


def n_modulating_harmonics(basis, lengths, n_inputs):
    """Harmonics that inputs are multiplied by, as many as the record tells apart; 0 for none.

    Half as many harmonics as rows in a period resolve all phases. Fewer are taken where the
    record is too short for all.
    """
    n_outputs = len(basis.output_labels)
    kept = max(k for _, orders in basis.outputs for k in orders)
    resolved = basis.rows_per_period // 2
    needed = min(2 * kept, resolved)  # what a harmonic decomposition asks for
    tries = [(2 * basis.window_rows + 2, h) for h in range(resolved, needed - 1, -1)]
    tries += [(basis.window_rows + 2, h) for h in range(needed, 0, -1)]
    choices = (
        highest
        for block_rows, highest in tries
        if n_hankel_columns(lengths, block_rows)
        >= 2 * block_rows * ((2 * highest + 1) * n_inputs + n_outputs)
    )
    return next(choices, 0)


def modulated(basis, drive, time, rows, highest):
    """One segment's inputs times the harmonic functions of ψ, as seen in the rows.

    Returns
    -------
    modulated : ndarray, shape (n_rows, m (2 highest + 1))
    """
    psi = 2.0 * np.pi * basis.phase_index(time) / basis.samples_per_period
    seen = []
    for k in range(highest + 1):  # one at a time, which bounds the memory
        waves = harmonic_functions(psi, [k])
        products = (drive[:, :, None] * waves[:, None, :]).reshape(len(drive), -1)
        held = basis.held_drive(products, rows)
        seen.append(held.reshape(len(rows), drive.shape[1], waves.shape[1]))
    return np.concatenate(seen, axis=2).reshape(len(rows), drive.shape[1] * (2 * highest + 1))


def modulated_inputs(experiment, lengths):
    """Inputs times the harmonic functions of ψ, as seen in the rows; None where u suffices."""
    basis = experiment.basis
    if changes_at_one_phase(experiment):
        return None
    highest = n_modulating_harmonics(basis, lengths, experiment.drive[0].shape[1])
    if highest == 0:
        return None
    return unit_size(
        [
            modulated(basis, u, time, basis.rows_read(time), highest)
            for u, time in zip(experiment.drive, experiment.times(), strict=True)
        ]
    )


def inputs_by_phase(experiment):
    """Inputs of each hop in the directions they move in, at each phase an input of its own.

    Yields
    ------
    choice : list of ndarray, shapes (n_rows_s, d r)
        For d = all directions, then fewer, down to one for each input: smooth inputs move
        little but in their means. r is the rows in a period.
    """
    basis = experiment.basis
    hops, phases = [], []
    for drive, time in zip(experiment.drive, experiment.times(), strict=True):
        rows = basis.rows_read(time)
        hops.append(_hops(drive, basis, rows))
        phases.append(basis.phase_index(time)[rows] // basis.hop)
    directions, n_all, _ = input_directions(hops)
    for count in range(n_all, min(n_all, experiment.drive[0].shape[1]) - 1, -1):
        choice = []
        for w, phase in zip(directions, phases, strict=True):
            marks = np.eye(basis.rows_per_period)[phase]
            choice.append((w[:, :count, None] * marks[:, None, :]).reshape(len(w), -1))
        yield unit_size(choice)


def _hops(drive, basis, rows):
    """Samples within the hop after each row's window, (n_rows, hop, m); held at the end."""
    hop, ends = basis.hop, rows + basis.lead
    if len(rows) == 0:
        return np.zeros((0, hop, drive.shape[1]))
    places = np.minimum(ends[:, None] + np.arange(hop), len(drive) - 1)
    return drive[places]


def unit_size(signals):
    """Signals divided by the root mean square of each channel over all segments."""
    stacked = np.vstack(signals)
    size = np.sqrt(np.mean(stacked**2, axis=0))
    return [u / np.where(size == 0.0, 1.0, size) for u in signals]
