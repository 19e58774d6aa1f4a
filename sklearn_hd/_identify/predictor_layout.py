"""Lags, harmonics and feedthrough of the predictor of samples, and the rows that tell them.

Akaike's criterion chooses lags and harmonics, Schwarz's whether D is free. A record that is too
short for any is refused here.
"""

from dataclasses import replace

import numpy as np

from sklearn_hd._checks import LITTLE
from sklearn_hd._identify.stages import MOST_PREDICTOR_ROWS, or_hop, warn_of_feedback
from sklearn_hd.algorithms.periodic.periodic_predictor import LagSums, Layout, spread_rows
from sklearn_hd.algorithms.signals.fourier import ROWS_PER_COLUMN

MOST_COLUMNS = 1000  # of the largest regression tried: its sums take seconds
MOST_HARMONICS = 3  # of the predictor, where the data choose
ROWS_COMPARED = 10_000  # of a longer record, choices are made on


def compared_rows(segments):
    """Segments, and slices of them, that choices are made on."""
    return spread_rows([len(y) for _, y, _ in segments], ROWS_COMPARED)


def predictor_layouts(data, settings, basis):
    """Lags, harmonics and feedthrough of the predictor, and why D is free or zero.

    Several where inputs are so smooth that a predictor cannot tell: with D = 0 and with D free, and
    each with more lags and with half of them, too. Few lags predict the next row then, but do not
    tell what comes later; many of a record without noise are large and cancel each other.
    """
    most, lags = _most(data, settings, basis)
    shortest = _shortest(data, settings)
    auto = settings.feedthrough == "auto"

    def layout(count, feedthrough):
        return Layout(
            data.n_inputs,
            data.n_outputs,
            lags,
            count,
            count if basis.n_input_harmonics is None else min(count, basis.n_input_harmonics),
            basis.most_loads,
            feedthrough,
        )

    compared = [[z[rows] for z in data.segments[s]] for s, rows in compared_rows(data.segments)]
    sums = LagSums.of(compared, layout(most, auto or settings.direct))
    least = lags if settings.block_rows is not None else shortest
    found = {}
    for count in range(most + 1):
        for feedthrough in (False, True) if auto else (settings.direct,):
            own = layout(count, feedthrough)
            aic, bic = sums.part(own).criteria(least)
            k = int(np.argmin(aic))
            found[count, feedthrough] = aic[k], bic[k], least + k
    fed_back = auto and settings.predictor  # D may stand for feedback within a row
    allowed = [key for key in found if not (fed_back and key[1])]
    count = min(allowed, key=lambda key: found[key][0])[0]

    def whole(feedthrough, lags):
        return replace(layout(count, feedthrough), n_lags=lags)

    if not auto:
        lags, reason = found[count, settings.direct][2], "feedthrough={} was asked for"
        return [whole(settings.direct, lags)], reason.format(settings.feedthrough)
    # a whole set of coefficients, which has to be worth it
    gain = found[count, False][1] - found[count, True][1]
    reason = f"the Bayesian information criterion of the predictor is {abs(gain):.3g} lower with "
    lags = [found[count, feedthrough][2] for feedthrough in (False, True)]
    tells = sums.part(whole(True, lags[1])).tells_feedthrough()
    if not tells:
        reason = (
            "earlier rows predict an input almost exactly, so that the predictor cannot tell D; of "
            "the models with D = 0 and with D free, the best has "
        )
    if fed_back:
        zero = [whole(False, lags[0])]
        if not tells or gain <= LITTLE * sums.n_rows:
            return zero, "weighting='pbsid' takes {}"
        warn_of_feedback(f"{reason}D free")
        return zero, f"{reason}D free, but feedback within a row looks the same: {{}}"
    if not tells:
        own, longest = max(lags), sums.layout.n_lags
        several = (k for k in (own, own // 2, 2 * own, 3 * own) if least <= k <= longest)
        both = [whole(feedthrough, each) for each in several for feedthrough in (False, True)]
        return both, reason + "{}"
    return [whole(bool(gain > 0.0), lags[int(gain > 0.0)])], reason + "{}"


def rows_told(data, lags):
    """Rows with so many before them: short segments have few, or none."""
    return sum(max(0, len(y) - lags) for _, y, _ in data.segments)


def _shortest(data, settings):
    """Fewest lags, which have to tell as many states as asked for."""
    return 2 if settings.order == "auto" else max(2, -(-settings.order // data.n_outputs))


def _most(data, settings, basis):
    """Most harmonics and lags that the record allows, of those asked for."""
    n_rows, longest = sum(len(y) for _, y, _ in data.segments), data.longest
    asked, shortest = settings.block_rows, _shortest(data, settings)
    if asked is not None and asked < shortest:
        raise ValueError(
            f"order={settings.order} exceeds the {asked * data.n_outputs} that block_rows={asked} "
            f"with {data.n_outputs} output(s) tell; lower order, or raise block_rows"
        )
    if asked is None and shortest > MOST_PREDICTOR_ROWS:
        raise ValueError(
            f"order={settings.order} with {data.n_outputs} output(s) takes {shortest} lags, and "
            f"{MOST_PREDICTOR_ROWS} are tried at most; lower order, or give block_rows={shortest} "
            f"or more"
        )
    given = basis.n_harmonics
    most = min(MOST_HARMONICS if given is None else given, basis.most_harmonics)
    least = asked or shortest
    for count in range(most, -1 if given is None else most - 1, -1):
        per_lag = (data.n_inputs + data.n_outputs) * (2 * count + 1)
        first = 2 * basis.most_loads + 1
        lags = min(
            MOST_PREDICTOR_ROWS, max((MOST_COLUMNS - first) // per_lag, shortest), longest // 3
        )
        while lags > shortest and rows_told(data, lags) < ROWS_PER_COLUMN * (
            first + lags * per_lag
        ):
            lags -= 1
        lags = lags if asked is None else asked
        if lags >= shortest and n_rows >= 2 * lags * per_lag and longest >= 3 * lags:
            return count, lags
    need = max(2 * least * per_lag, 3 * least)
    raise ValueError(
        f"the {data.facts.span} give {n_rows} rows, the longest segment {longest}, too few for "
        f"a predictor of {least} lags with {count} harmonic(s) of "
        f"{data.n_inputs + data.n_outputs} signals: {need} rows in one segment would do"
        f"{data.facts.why_short}; use a longer record, fewer block_rows, a lower order, or a "
        f"smaller output_harmonics in HarmonicAnalyzer{or_hop(basis)}"
    )
