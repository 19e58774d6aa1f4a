"""Checks of block rows, order and weighting against the data."""

from dataclasses import replace

import numpy as np

from sklearn_hd._checks import check_choice, check_count, check_flag, check_positive
from sklearn_hd._identify.products_cache import KeptSums
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.predictor_subspace import rows_remembered
from sklearn_hd.algorithms.subspace.projections import PROJECTIONS
from sklearn_hd.exceptions import ExcitationWarning

DEFAULT_BLOCK_ROWS = 15
PREDICTOR = "pbsid"
MOST_PREDICTOR_ROWS = 60
NOTABLE = 0.01  # share of the innovations that is worth a warning
COLUMNS_PER_ROW = 10  # for each coefficient of the longest predictor tried
ROWS_BEYOND = 2  # so that order="auto" has room above the order that noise-free data show
WEIGHTINGS = (*PROJECTIONS, PREDICTOR)


def checked(settings):
    """The settings, flags as bool; ValueError for one that is not understood."""
    if not isinstance(settings.order, str):
        check_count("order", settings.order, 1, "'auto' chooses it")
    elif settings.order != "auto":
        raise ValueError(f"order={settings.order!r} is not known; give a whole number or 'auto'")
    KeptSums(settings.memory)
    check_choice("weighting", settings.weighting, WEIGHTINGS)
    if settings.block_rows is not None:
        check_count("block_rows", settings.block_rows, 2, "None chooses them")
    if settings.half_life is not None and settings.half_life != np.inf:
        hint = "partial_fit then forgets old rows; None or infinity forgets nothing"
        check_positive("half_life", settings.half_life, "periods, or seconds", hint)
    free = settings.feedthrough
    if not (isinstance(free, bool | np.bool_) or (isinstance(free, str) and free == "auto")):
        raise ValueError(f"feedthrough must be True, False or 'auto', got {free!r}")
    settings = replace(settings, feedthrough=free if isinstance(free, str) else bool(free))
    flags = ("disturbance_model", "scale", "stable")
    return replace(settings, **{name: check_flag(name, getattr(settings, name)) for name in flags})


def check_rank_bound(order, block_rows, n_outputs):
    """Raise ValueError if block rows do not have the rank that an order asks for."""
    bound = (block_rows - 1) * n_outputs
    if order != "auto" and order > bound:
        raise ValueError(
            f"order={order} exceeds the rank bound {bound} of block_rows="
            f"{block_rows} with {n_outputs} outputs; lower order or raise block_rows"
        )


def fewer_block_rows(asked, least, lengths, n_channels):
    """Block rows asked for by default, or fewer where the record is short."""
    i = asked
    while i > least and n_hankel_columns(lengths, i) < 2 * i * n_channels:
        i -= 1
    return i


def allowed_block_rows(settings, data, asked, *, least=2, words=None):
    """Block rows that the order and the record allow.

    Parameters
    ----------
    settings : Settings
    data : Records, Summed or Partitions
    asked : int
        Block rows given, or the default of the reading.
    least : int
        Block rows that the reading needs.
    words : (str, str, str), optional
        What a row and a channel are called, and the way out.

    Returns
    -------
    block_rows : int
    """
    i, n_inputs, n_outputs = asked, data.n_inputs, data.n_outputs
    if settings.block_rows is None:
        i = fewer_block_rows(asked, least, data.lengths, n_inputs + n_outputs)
    check_rank_bound(settings.order, i, n_outputs)
    # the future inputs, i m rows, are projected out of j = n_rows − 2 i + 1 columns
    n_projected = n_inputs + (n_outputs if settings.predictor else 0)
    need = i * n_projected + 1 + (1 if settings.order == "auto" else int(settings.order))
    if n_hankel_columns(data.lengths, i) < need:
        unit, moving, way_out = words or (
            "row",
            "input(s)",
            "use a longer record, fewer block rows or a smaller hop",
        )
        rows = f"{sum(data.lengths)} {unit}(s) (n_samples = {data.facts.n_samples})"
        raise ValueError(
            f"the {data.facts.span()} give {rows}, which are too few for block_rows={i}: at least "
            f"{need + 2 * i - 1} consecutive {unit}s are needed with {n_inputs} "
            f"{moving}{data.facts.why_short}; {way_out}"
        )
    return i


def warn_excitation(excited, block_rows, n_moving, span):
    """Warn of Hankel matrices of deficient rank."""
    need = 2 * block_rows * n_moving
    if excited < need:
        warn(
            f"the inputs in the {span} excite {excited} directions, but block_rows={block_rows} "
            f"with {n_moving} input(s) needs {need}; use a richer input or fewer block rows, and "
            f"check the order with care",
            ExcitationWarning,
        )


def rows_of_predictor(data, first, size, settings):
    """Block rows after which the predictor has forgotten its state, and the order fits in.

    Beyond the directions that the inputs excite there are many predictors, whose states are no
    one's.

    Parameters
    ----------
    data : Records, Summed or Partitions
    first : int
        Block rows of the shortest predictor tried.
    size : ndarray, shape (n_inputs + n_outputs,)
    settings : Settings

    Returns
    -------
    block_rows : int
    """
    n_inputs, n_outputs, lengths = data.n_inputs, data.n_outputs, data.lengths
    lifted = data.facts.basis.reading == "period"  # inputs act at once, all directions excited
    most = first
    longest = min(MOST_PREDICTOR_ROWS, data.most_block_rows)
    while most < longest and n_hankel_columns(lengths, most + 1) >= (
        COLUMNS_PER_ROW * (most + 1) * (n_inputs + n_outputs)
    ):
        most += 1
    R = data.factor(most, size)
    if not lifted and n_inputs:
        excited = n_excited(R, most, n_inputs)
        if excited < 2 * most * n_inputs:
            most = max(2, excited // (2 * n_inputs))
            warn(
                f"the inputs excite only {excited} directions, so a predictor can use at most "
                f"{most} past rows: dynamics that last longer are lost; use a richer input",
                ExcitationWarning,
            )
            R = data.factor(most, size)
    columns = n_hankel_columns(lengths, most)
    order = 1 if settings.order == "auto" else int(settings.order)
    rows = rows_remembered(R, most, n_inputs, columns, settings.direct or lifted)
    rows = min(most, max(rows, -(-order // n_outputs)) + ROWS_BEYOND)
    check_rank_bound(settings.order, rows, n_outputs)
    return rows
