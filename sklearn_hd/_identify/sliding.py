"""``reading="sliding"``: identification of coefficients as a window sees them, row by row.

The projection removes the inputs from the future, or, if they change at more than one phase of the
period, the inputs times harmonics of ψ. Block rows must exceed the window, whose memory would
otherwise be mistaken for dynamics.

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

from sklearn_hd._fit_checks import check_motion
from sklearn_hd._identify.stages import allowed_block_rows, decompose, fit_matrices, subspace_fit
from sklearn_hd._identify.statistics import Facts, Records
from sklearn_hd._readings import highest_harmonic
from sklearn_hd._records.data import rows_read
from sklearn_hd._residuals import MOST_PRODUCTS
from sklearn_hd.algorithms.linalg.rounding import PRECISION
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.algorithms.modes.families import FAINT, agreeing_copies, is_window_pole
from sklearn_hd.algorithms.signals.fourier import harmonic_functions, input_directions
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns

STEP_SHARE = 0.25  # of an input's largest change, below which one is no step, but maybe noise


def read(experiment, settings):
    """Data of an experiment: windowed coefficients, and the inputs as the window sees them."""
    inputs, outputs = rows_read(experiment)
    data = Records(inputs, outputs, Facts.of(experiment, inputs), settings.memory)
    turned = modulated_inputs(experiment, data.lengths)
    return data if turned is None else data.with_excitation(turned)


def identify(data, settings, experiment=None):
    """Identify a model of windowed coefficients, row by row: a SubspaceFit.

    ``data`` are Records, Summed or Partitions. ``experiment`` is given where data are
    in memory; more ways to an exact model are then tried.
    """
    basis = data.facts.basis
    asked, least = asked_block_rows(basis, settings), basis.window_rows + 2
    _check_rows_per_period(basis)
    i = allowed_block_rows(settings, data, asked, least=least)
    check_motion(data.facts)
    size, scales = data.scales(settings.scale)
    decomposition = decompose(data, i, size, settings)
    while _fills_its_rank(decomposition, data, settings):
        more = _more_block_rows(decomposition.block_rows)
        decomposition = decompose(data, more, size, settings)
    if settings.chooses and experiment is not None:
        decomposition = _exact_map(decomposition, data, experiment, settings)
    fitted = fit_matrices(data, decomposition, size, scales, settings, settings.direct)
    reason = "a window averages direct input effects: D is zero unless feedthrough=True"
    return subspace_fit(
        decomposition,
        fitted,
        scales,
        data.facts,
        settings,
        settings.direct,
        feedthrough_reason=reason,
    )


def asked_block_rows(basis, settings):
    """Block rows given, or the default: twice the window's rows, plus two.

    It raises ValueError if they do not exceed the window's rows plus one, or the noise
    is asked for: a window averages it.
    """
    if settings.disturbance_model or settings.predictor:
        asked = "disturbance_model=True"
        if settings.predictor:
            asked = f"weighting={settings.weighting!r}"
        raise ValueError(
            f"{asked} identifies the noise from row to row, but a sliding window averages rows and "
            f"leaves no predictor; use HarmonicAnalyzer(reading='period'), or plain data"
        )
    if settings.block_rows is None:
        return 2 * basis.window_rows + 2
    i = int(settings.block_rows)
    if i <= basis.window_rows + 1:
        raise ValueError(
            f"block_rows={i} must exceed the {basis.window_rows} rows in the analysis window plus "
            f"one, or the window's own memory is mistaken for dynamics; use "
            f"block_rows={basis.window_rows + 2} or more, or a larger hop"
        )
    return i


def _check_rows_per_period(basis):
    highest = highest_harmonic(basis.outputs)
    if basis.rows_per_period <= 2 * highest:
        most = basis.samples_per_period // (2 * highest + 1)
        raise ValueError(
            f"hop={basis.hop} reads {basis.rows_per_period} rows per period, too few for harmonic "
            f"{highest}: copies of the modes alias onto the modes; use a hop of at most {most}, or "
            f"reading='period'"
        )


def _more_block_rows(block_rows):
    """Half as many again."""
    return block_rows + (block_rows + 1) // 2


def _fills_its_rank(decomposition, data, settings):
    """Whether the order chosen fills the rank that default block rows allow, and more fit.

    Few coefficients of many states: copies and memory need more rows than a window's.
    """
    if not settings.chooses:
        return False
    i, n_outputs = decomposition.block_rows, data.n_outputs
    more = _more_block_rows(i)
    if more > data.most_block_rows:
        return False
    room = n_hankel_columns(data.lengths, more) >= 2 * more * (data.n_inputs + n_outputs)
    return decomposition.order >= (i - 1) * n_outputs and room


def _exact_map(decomposition, data, experiment, settings):
    """The model without noise in which most modes have copies that agree.

    Inputs that move within a hop at many phases ask for many inputs, more than noise
    would let be told apart; few coefficients of many states ask for many block rows.
    Where no more than rounding is left, noise is no matter. A model whose inputs are too
    few leaves no more, by modes that stand for inputs, but these have no copies.
    """
    basis, one_phase = experiment.basis, changes_at_one_phase(experiment)
    if one_phase and _is_exact(decomposition, data):
        return decomposition
    best, most = decomposition, _n_agreeing(decomposition, basis)
    choices = [data] if one_phase else map(data.with_excitation, inputs_by_phase(experiment))
    for tried in choices:
        rows = (int(windows * basis.window_rows) + 2 for windows in (4, 3, 2, 1.5, 1))
        i = next((i for i in rows if _fits(tried, i)), 0)
        if i == 0:
            continue
        other = decompose(tried, i, tried.scales(settings.scale)[0], settings)
        if _is_exact(other, tried):
            agreeing = _n_agreeing(other, basis)
            if agreeing > most:
                best, most = other, agreeing
    return best


def _n_agreeing(decomposition, basis):
    """Modes of the model that belong to families with all their copies."""
    z = np.linalg.eigvals(decomposition.found.state_matrices(decomposition.order)[0])
    z = z[~is_window_pole(z, basis.window_rows, FAINT)]
    orders = [orders for _, orders in basis.outputs]
    return int(agreeing_copies(z, orders, basis.rows_per_period).sum())


def _is_exact(decomposition, data):
    """Whether rounding is all that is left, and rank and record allow for more states."""
    i, order = decomposition.block_rows, decomposition.order
    room = order <= (i - 2) * data.n_outputs
    left = n_hankel_columns(data.lengths, i) - i * data.n_inputs >= order + i
    floor, largest = decomposition.noise_floor, decomposition.singular_values[0]
    return room and left and floor <= PRECISION * largest


def _fits(data, block_rows):
    """Whether inputs leave a quarter of the columns, and it takes no more than some seconds."""
    columns = n_hankel_columns(data.lengths, block_rows)
    left = columns - block_rows * data.n_inputs
    work = columns * (2.0 * block_rows * (data.n_inputs + data.n_outputs)) ** 2
    return left >= max(columns // 4, block_rows) and work <= MOST_PRODUCTS


# ---- inputs as a window sees them -------------------------------------------------------------


def changes_at_one_phase(experiment):
    """Whether all steps of the inputs fall on one sample of the period."""
    return steps_at_one_phase(changes_of(experiment))


def changes_of(experiment):
    """Largest change of each input over all segments, by phase."""
    pairs = zip(experiment.drive, experiment.times(), strict=True)
    return np.max([largest_changes(experiment.basis, *pair) for pair in pairs], axis=0)


def largest_changes(basis, drive, time):
    """Largest change of each input from one sample to the next, by the phase of the latter.

    Shape (samples_per_period, m).
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

    Shape (n_rows, m (2 highest + 1)).
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
    return unit_size(modulated_rows(experiment, highest))


def modulated_rows(experiment, highest):
    """The inputs of each segment times the harmonic functions, as seen in its rows."""
    basis, parts = experiment.basis, zip(experiment.drive, experiment.times(), strict=True)
    return [modulated(basis, u, time, basis.rows_read(time), highest) for u, time in parts]


def inputs_by_phase(experiment):
    """Inputs of each hop in the directions they move in, at each phase an input of its own.

    Each choice has arrays (n_rows_s, d r), where r is the rows in a period. The first
    choice has d = all directions, the others have fewer, down to one for each input:
    smooth inputs move little but in their means.
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
    size = column_rms(np.vstack(signals))
    return [u / size for u in signals]
