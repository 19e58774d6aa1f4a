"""``reading="period"``: identification of the Poincaré map, one row per period.

The outputs of a period respond to every sample of the inputs within it, whatever harmonics of them
are kept. The projection therefore removes the directions in which inputs move within the period. D
is always free, because inputs act within their own period.
"""

from dataclasses import replace

import numpy as np
from scipy import linalg
from scipy.stats import chi2

from sklearn_hd._excitation import MOST_OUTSIDE
from sklearn_hd._fit_checks import (
    check_motion,
    grows,
    grows_by,
    growth_rate,
    longest_span,
    warn_of_growth,
)
from sklearn_hd._frame import Lifted
from sklearn_hd._guards import held_back, searching, warn
from sklearn_hd._identify import sample
from sklearn_hd._identify.stages import (
    DEFAULT_BLOCK_ROWS,
    allowed_block_rows,
    by_gap,
    check_told_from_loads,
    decompose,
    fit_matrices,
    root_mean_square,
    rows_of_predictor,
    subspace_fit,
)
from sklearn_hd._identify.statistics import Facts, Records
from sklearn_hd._opinion import (
    DOUBT,
    LASTING,
    SURE,
    decays_at_rest,
    more_doubtful,
    of_free_decays,
    of_multipliers,
    warn_unconfirmed,
)
from sklearn_hd._records.data import (
    beside_trim,
    lifted_periods,
    moving_periods,
    output_scale,
    rows_read,
)
from sklearn_hd.algorithms.linalg.rounding import EXACT, TINY
from sklearn_hd.algorithms.linalg.triangular import column_rms
from sklearn_hd.algorithms.lti.simulation import propagate
from sklearn_hd.algorithms.modes.free_decay import (
    MOST_STATES,
    apart,
    free_decay,
    is_product,
    logarithms,
    offsets,
    smooth_parts,
    without_products,
)
from sklearn_hd.algorithms.periodic.multipliers import (
    cost_of_a_state,
    leaves_white_noise,
    left_by,
    multiplier_deviations,
    order_by_residual,
    outgrows_numbers,
    refine_multipliers,
    turned_back,
    without_noise_growth,
)
from sklearn_hd.algorithms.periodic.periodic_realization import (
    driven_states,
    forced_waveform,
    response_to_states,
    state_response,
)
from sklearn_hd.algorithms.signals.fourier import input_directions
from sklearn_hd.algorithms.signals.trim import LEVEL
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns
from sklearn_hd.algorithms.subspace.order import order_by_wide_gap
from sklearn_hd.exceptions import (
    ExcitationWarning,
    IdentifiabilityWarning,
    InstabilityWarning,
)

A_TENTH_LESS = 0.9  # left by the multipliers identified, in parts of that by the refined ones
WORDS = "period", "direction(s) of inputs", "use a longer record, or fewer block rows"


def read(experiment, settings):
    """Data of an experiment: its periods, and the directions that inputs move in within them."""
    inputs, outputs = rows_read(experiment)
    excitation = _excitation(experiment, settings)
    return Records(inputs, outputs, Facts.of(experiment, inputs), settings.memory, excitation)


def asked_block_rows(basis, settings):
    """Block rows given, or four; a predictor has to forget its state, and has 15."""
    if settings.block_rows is not None:
        return int(settings.block_rows)
    return DEFAULT_BLOCK_ROWS if settings.predictor else 2 * basis.window_rows + 2


def identify(data, settings, experiment):
    """Identify the Poincaré map, as :func:`~sklearn_hd._identify.plain.identify` a plain model.

    A map that grows gives way to a stable one that leaves no more of the record. Folds of a search
    are scored as they are.
    """
    told = []
    try:
        with held_back() as told:
            fit = _identified(data, settings, experiment)
        # feedback may hold a predictor's machine
        free = not (settings.stable or settings.predictor or searching())
        if free and grows(fit.model.A, fit.model.dt, experiment):
            fit, told = _or_stable(fit, told, data, settings, experiment)
    finally:
        for message, category in told:
            warn(message, category)
    return fit


def _or_stable(fit, told, data, settings, experiment):
    """A stable map instead of one that grows, if it leaves no more, and the warnings."""
    with held_back() as others:
        try:
            stable = _identified(data, replace(settings, stable=True), experiment)
        except ValueError:  # none of the maps tried is stable
            return fit, told
    if stable.left > min(fit.left, 1.0):
        return fit, told
    growth = growth_rate(fit.model.A, fit.model.dt) * longest_span(experiment)
    words = (
        f"the map identified {grows_by(growth)} over the longest segment, but a stable one leaves "
        f"no more of the record: that takes its place; use smaller motions, or give order="
    )
    return stable, [*others, (words, InstabilityWarning)]


def _identified(data, settings, experiment):
    """The map with its warnings."""
    i = allowed_block_rows(
        settings, data, asked_block_rows(data.facts.basis, settings), words=WORDS
    )
    check_motion(data.facts)
    _check_told_from_loads(experiment)
    size, scales = data.scales(settings.scale)
    if settings.predictor and settings.block_rows is None:
        i = rows_of_predictor(data, i, size, settings)

    def choose(found, bound):
        return _order(found, bound, experiment, data, settings)

    decomposition = decompose(data, i, size, settings, choose)
    matrices, noise, x0 = fit_matrices(data, decomposition, size, scales, settings, True)
    still, at_rest, known, forced = None, False, None, None
    if settings.predictor:
        known = matrices[1], _predicted_states(matrices, noise[0], x0, data, scales[1])
        matrices = _driven_by_means(matrices, data, scales[0])
    else:
        A, B, C, D = matrices
        Phi, C, still, at_rest = _own_map(A, C, noise, experiment, data, scales[1], settings)
        decomposition = replace(decomposition, order=len(Phi))
        if not experiment.basis.trim_known:
            forced = _forced(Phi, experiment, data)
            data = _less(data, forced, experiment.basis)
        if Phi is not A or forced is not None:
            B, D, x0 = data.input_matrices(Phi, C, True, scales)
            matrices = Phi, B, C, D
    fitted = matrices, noise, x0
    reason = "inputs act within the period that they belong to: D is free"
    fit = subspace_fit(
        decomposition, fitted, scales, data.facts, settings, True, feedthrough_reason=reason
    )
    opinion, exponents = of_free_decays(still, experiment, at_rest), fit.model.exponents()
    warn_of_growth(fit.model, experiment)
    held = opinion
    if not (settings.predictor or at_rest or searching()):
        own = _of_its_likelihood(fit.model, experiment, data)
        told = bool(np.isfinite(own.deviations).any())
        opinion = _of_another_way(opinion, told, experiment)
        held = more_doubtful(exponents, opinion, own if told or opinion is None else None)
    warn_unconfirmed(exponents, held)
    doubt = 0.0 if held is None else held.doubt(exponents)
    model = _lifted(fit.model, data, experiment, known, forced)
    second_order = still.beside if at_rest else ()
    model = replace(model, at_rest=at_rest, second_order=second_order, opinion=opinion)
    left = _left_of_motion(model, experiment)
    return replace(fit, model=model, forced=forced, doubt=doubt, left=left)


def _check_told_from_loads(experiment):
    """Raise ValueError if an input does the same at every turn, an incomplete one too."""
    basis, turn = experiment.basis, np.vstack(lifted_periods(experiment, experiment.inputs))
    mean, segments = turn.mean(axis=0), zip(experiment.inputs, experiment.times(), strict=True)
    left = root_mean_square([u - mean[basis.phase_index(time)] for u, time in segments])
    waves = mean if basis.input_trim is None else mean + basis.input_trim
    check_told_from_loads(waves, left, experiment)


def _left_of_motion(model, experiment):
    """Share of the outputs' variance about their mean turn that the lifted model leaves."""
    if model.lifted is None:
        return np.inf
    y = np.vstack(_raw_periods(experiment))
    return model.lifted.left * float(np.sum(y**2) / max(np.sum((y - y.mean(axis=0)) ** 2), TINY))


def _of_another_way(opinion, told, experiment):
    """The opinion of free decays, or of samples where inputs move, or their rest tells none.

    Its word is needed where the likelihood has told nothing of the model's own multipliers.
    """
    if opinion is None or not (told or opinion.tells):
        opinion = sample.opinion(experiment) or opinion
    return opinion if told or opinion is None else replace(opinion, needed=True)


def _of_its_likelihood(model, experiment, data):
    """What the whole record tells of the model's own multipliers.

    Deviations are infinite where it tells nothing: inputs that move in many directions can explain
    all of a short record, whatever the multipliers are.
    """
    found = multiplier_deviations(model.A, data.excitation, _raw_periods(experiment))
    return of_multipliers(*found, experiment, "its own likelihood has", True)


def _lifted(model, data, experiment, known, forced):
    """The model with what happens within its periods, by linear least squares.

    B and the states are known of a predictor. Of a map that outgrows numbers within the record
    nothing more is.
    """
    A, W, scale = model.A, data.excitation, output_scale(experiment)
    lifted = lifted_periods(experiment, experiment.outputs, scale)
    outputs = [y.reshape(len(y), -1) for y in lifted]
    longest = max(map(len, outputs))
    if outgrows_numbers(A, longest):
        return model
    basis, constant = experiment.basis, experiment.basis.output_trim is not None
    if forced is not None:  # which holds what the constant direction would
        outputs = [y - (forced / scale).ravel() for y in outputs]
        W, constant = [w[:, :-1] for w in W], False
    if known is not None:
        B, states = known
    else:
        unit = column_rms(np.vstack(data.outputs))
        C, seen = model.C / unit[:, None], [Y / unit for Y in data.outputs]
        B, states = driven_states(A, C, W, outputs, seen)
    sights = response_to_states(states, W, outputs)[0]
    W, outputs, states = map(np.vstack, (W, outputs, states))
    D = linalg.lstsq(W, outputs - states @ sights.T)[0].T
    left = np.sum((outputs - states @ sights.T - W @ D.T) ** 2) / max(np.sum(outputs**2), TINY)
    u = np.vstack(lifted_periods(experiment, experiment.inputs))
    if not constant:
        W, B, D = (np.pad(M, ((0, 0), (0, 1))) for M in (W, B, D))
    size = np.sqrt(np.mean(u**2, axis=(0, 1)))
    size = np.tile(np.where(size > 0.0, size, 1.0), u.shape[1])
    directions = linalg.lstsq(u.reshape(len(u), -1) / size, W[:, :-1])[0] / size[:, None]
    scale = np.tile(scale, basis.samples_per_period)[:, None]
    return replace(model, lifted=Lifted(B, scale * sights, scale * D, directions, float(left)))


def _excitation(experiment, settings):
    """Directions of the inputs within the period, as many as the record tells apart."""
    lifted = lifted_periods(experiment, experiment.inputs)
    rows = 2 if settings.block_rows is None else settings.block_rows
    states = 1 if settings.order == "auto" else settings.order
    lengths = [len(u) for u in lifted]
    most = max(1, (n_hankel_columns(lengths, rows) - 1 - states) // rows)
    directions, n_all, left_out = input_directions(lifted, most)
    if n_all > most:
        need = rows * n_all + 1 + states + 2 * rows - 1
        words = (
            f"the inputs in the {experiment.span()} move in {n_all} directions within the period, "
            f"and {sum(lengths)} periods can separate {most} of them at block_rows={rows}: "
            f"{left_out:.2g} of their energy counts as noise; {need} consecutive periods would be "
            f"enough"
        )
        if left_out > MOST_OUTSIDE:
            raise ValueError(
                f"{words}; use a longer record, inputs that change less often, or "
                f"HarmonicAnalyzer(reading='sample'), with hop=1 if they change at each sample"
            )
        warn(words, ExcitationWarning)
    return beside_trim(directions, experiment.basis)


def _order(found, bound, experiment, data, settings):
    """The order of a wide gap, else the one whose simulation leaves least of the raw periods."""
    wide = order_by_wide_gap(found.singular_values, found.floor, bound)
    # a predictor's feedback would be cut by a simulation
    if wide is not None or settings.predictor:
        return by_gap(found, bound)
    lifted = _raw_periods(experiment)
    # half as many as the periods left once the inputs' directions are projected out
    left = sum(map(len, lifted)) - data.n_inputs
    most = min(bound, MOST_STATES, left // 2)
    if most < 1:
        return by_gap(found, bound)
    candidates = [found.state_matrices(n + 1, settings.stable)[0] for n in range(most)]
    return len(order_by_residual(candidates, data.excitation, lifted))


def _raw_periods(experiment):
    """Every sample of the outputs that move, one row a period, in like units."""
    return [y.reshape(len(y), -1) for y in moving_periods(experiment)]


def _own_map(A, C, noise, experiment, data, unit, settings):
    """The machine's map, what is seen of its states, free decays, and whether it is theirs.

    Where one linear map does not explain the whole record except for noise, inputs have held a
    nonlinear machine away from its orbit: its own map is that of its free decays, and products of
    their multipliers are second-order responses. So are those that the whole record alone has.
    """
    period = 2.0 * np.pi / experiment.basis.omega
    Phi, turned = _refined(A, C, experiment, data, unit, settings.stable)
    raw, stretches = decays_at_rest(experiment)
    decays = smooth_parts(raw)
    still = free_decay(decays, None if settings.order == "auto" else settings.order)
    less = still is None or noise is not None
    less = less or (settings.stable and grows(still.Phi, period, experiment))
    auto = settings.order == "auto"
    linear = less or _linear(Phi, still, decays, experiment, data)
    if less or (linear and not (auto and _of_second_order(Phi, still, decays))):
        _warn_of_turned(turned)
        return Phi, C, still, False
    if auto:
        still = without_products(still, decays)
    _warn_of_turned(still.turned)
    return still.Phi, _sight(still, stretches, data, unit), still, True


def _warn_of_turned(multiplier):
    """Warn of a negative multiplier that was turned back, if a period leaves some of its motion."""
    if abs(multiplier) < LASTING or searching():
        return
    warn(
        f"an odd number of multipliers came out negative, which no periodic system has (their "
        f"product is positive): noise, or a wrong order, has turned the sign of the smallest, and "
        f"the model has {-multiplier:.3g} instead of {multiplier:.3g}; do not rely on that mode: "
        f"try another order, or use a longer record",
        IdentifiabilityWarning,
    )


def _refined(A, C, experiment, data, unit, stable):
    """The map of largest likelihood for the raw periods, or that identified if it leaves less,
    and the negative multiplier that was turned back: one whose sign the record does not tell."""
    directions, lifted = data.excitation, _raw_periods(experiment)
    if grows(A, 2.0 * np.pi / experiment.basis.omega, experiment):
        refined = without_noise_growth(A, directions, lifted)
    else:
        refined = refine_multipliers(A, directions, lifted, 1.0 if stable else None)
    seen = [Y / unit for Y in data.outputs]
    kept = unless_it_leaves_less(refined, A, C, directions, lifted, seen)
    possible, turned = turned_back(kept)
    if turned and unless_it_leaves_less(possible, kept, C, directions, lifted, seen) is possible:
        return possible, turned
    return kept, 0.0


def unless_it_leaves_less(refined, identified, C, directions, lifted, seen):
    """The refined map, or that identified if it leaves a tenth less of the record.

    Multipliers are refined with every mode free to answer in its own way to each direction of
    the inputs. Many modes that last but a period or two can then stand for each other, and noise
    decides; with one B for all that is seen they cannot.
    """
    longest = max(map(len, lifted))
    if outgrows_numbers(identified, longest):
        return refined
    if outgrows_numbers(refined, longest):
        return identified
    left, others = (
        np.sum(state_response(Phi, C, directions, lifted, seen)[2]) for Phi in (refined, identified)
    )
    return identified if others < A_TENTH_LESS * left else refined


def _linear(Phi, still, decays, experiment, data):
    """Whether one map explains the whole record except for noise, and free decays as well as any.

    By the ratio of likelihoods (Wilks, 1938).
    """
    if not leaves_white_noise(Phi, data.excitation, _raw_periods(experiment)):
        return False
    ones, target = offsets(decays), np.vstack(decays)
    n_free = cost_of_a_state(ones, decays)[0]
    left, own = (np.sum(left_by(M, ones, target) ** 2) for M in (Phi, still.Phi))
    least = EXACT**2 * np.sum(target**2)
    ratio = n_free * np.log(max(left, least) / max(own, least))
    return ratio <= chi2.isf(LEVEL, max(len(Phi), len(still.Phi)))


def _of_second_order(Phi, still, decays):
    """Whether a map has the modes of free decays and besides them only products of these.

    Or one that outlasts the decays: what the trim is off by. What a period forgets is not judged,
    and free decays that do not know their own modes judge nothing.
    """
    own, known = (logarithms(linalg.eigvals(M)) for M in (Phi, still.Phi))
    rates = np.abs(np.log(np.abs(still.multipliers)))
    if np.any(SURE * still.deviations > DOUBT * rates):
        return False
    own = own[own.real >= np.log(LASTING)]
    beside = own[apart(own, known).min(axis=1) > DOUBT * np.abs(own.real)]
    found = is_product(beside, known, DOUBT * np.abs(beside.real))
    found |= np.abs(beside.real) * max(map(len, decays)) < 1.0
    return len(beside) > 0 and bool(found.all())


def _sight(still, stretches, data, unit):
    """C of the states of free decays, by least squares beside what the trim is off by."""
    seen = np.vstack([data.outputs[s][rows] for s, rows in stretches]) / unit
    known = np.hstack([np.vstack(still.states), np.vstack(offsets(still.states))])
    return linalg.lstsq(known, seen)[0][: len(still.Phi)].T


def _forced(Phi, experiment, data):
    """What the trim of the outputs is off by: their waveform without inputs and states."""
    lifted = lifted_periods(experiment, experiment.outputs)
    directions = [w[:, :-1] for w in data.excitation]  # without that of the trim
    flat = [y.reshape(len(y), -1) for y in lifted]
    return forced_waveform(Phi, directions, flat).reshape(lifted[0].shape[1:])


def _less(data, waveform, basis):
    """Data less the coefficients of a waveform of the outputs."""
    time = np.arange(len(waveform)) * basis.sample_time
    off = basis.output_coefficients(waveform, time, np.zeros(1, dtype=int))
    outputs = [Y - off for Y in data.outputs]
    return Records(data.inputs, outputs, data.facts, data.kept, data.excitation)


def _predicted_states(matrices, K, starts, data, y_scale):
    """States of a predictor at the beginning of each period, its innovations their own."""
    A, B, C, D = matrices
    parts = zip(data.outputs, data.excitation, starts, strict=True)
    return [propagate(A - K @ C, Y / y_scale @ K.T + w @ (B - K @ D).T, x0) for Y, w, x0 in parts]


def _driven_by_means(matrices, data, u_scale):
    """Matrices of a predictor driven by the mean inputs, which stand for what moves within."""
    A, B, C, D = matrices
    u = np.vstack(data.inputs)
    offset = np.ones((len(u), 1))  # of the trim, which is no input
    share = linalg.lstsq(np.hstack([u / u_scale, offset]), np.vstack(data.excitation))[0]
    B, D = (M @ share[:-1].T for M in (B, D))
    return A, B, C, D
