"""What block rows, order and weighting the data allow."""

from sklearn_hd._checks import check_choice, check_count, check_flag
from sklearn_hd._identify.products_cache import KeptSums
from sklearn_hd._progress import check_verbose
from sklearn_hd._time import why_short
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.subspace.hankel import n_excited, n_hankel_columns
from sklearn_hd.algorithms.subspace.predictor_subspace import rows_remembered
from sklearn_hd.algorithms.subspace.projections import PROJECTIONS
from sklearn_hd.exceptions import ExcitationWarning

__all__ = ["PREDICTOR", "SubspaceChecks", "is_lifted"]

DEFAULT_BLOCK_ROWS = 15
PREDICTOR = "pbsid"
MOST_PREDICTOR_ROWS = 60
COLUMNS_PER_ROW = 10  # for each coefficient of the longest predictor tried
ROWS_BEYOND = 2  # so that order="auto" has room above the order that noise-free data show
WEIGHTINGS = (*PROJECTIONS, PREDICTOR)


def is_lifted(experiment):
    """Whether the record is read period by period."""
    return experiment.basis.reading == "period"


class SubspaceChecks:
    """Parameters of a subspace method, checked against each other and the data."""

    def _check_parameters(self):
        """Scale and feedthrough as flags, once all parameters are checked."""
        self._check_warmup()
        self._check_order()
        check_verbose(self.verbose)
        KeptSums(self.memory)
        check_choice("weighting", self.weighting, WEIGHTINGS)
        check_flag("disturbance_model", self.disturbance_model)
        if self.block_rows is not None:
            check_count("block_rows", self.block_rows, 2, "None chooses them")
        return check_flag("scale", self.scale), check_flag("feedthrough", self.feedthrough)

    def _check_order(self):
        if isinstance(self.order, str):
            if self.order != "auto":
                raise ValueError(
                    f"order={self.order!r} is not known; give a whole number or 'auto'"
                )
            return
        check_count("order", self.order, 1, "'auto' chooses it")

    def _check_rank_bound(self, block_rows, n_outputs):
        bound = (block_rows - 1) * n_outputs
        if self.order != "auto" and self.order > bound:
            raise ValueError(
                f"order={self.order} exceeds the rank bound {bound} of block_rows="
                f"{block_rows} with {n_outputs} outputs; lower order or raise block_rows"
            )

    def _block_rows_asked(self, basis):
        """Block rows given, or the default, which must exceed the window."""
        sliding = basis.reading == "sliding"
        self._check_noise_is_white(sliding)
        if self.block_rows is None:
            # a predictor has to forget its state
            long = not basis.harmonic or self.weighting == PREDICTOR
            return DEFAULT_BLOCK_ROWS if long else 2 * basis.window_rows + 2
        i = int(self.block_rows)
        if sliding and i <= basis.window_rows + 1:
            raise ValueError(
                f"block_rows={i} must exceed the {basis.window_rows} rows in the analysis window "
                f"plus one, or the window's own memory is mistaken for dynamics; use block_rows="
                f"{basis.window_rows + 2} or more, or a larger hop"
            )
        return i

    def _check_noise_is_white(self, sliding):
        """Raise ValueError if the noise is asked for through a window that slides."""
        if sliding and (self.disturbance_model or self.weighting == PREDICTOR):
            asked = "disturbance_model=True"
            if self.weighting == PREDICTOR:
                asked = f"weighting={PREDICTOR!r}"
            raise ValueError(
                f"{asked} identifies the noise from row to row, which a sliding window averages "
                f"until no predictor is left; use HarmonicAnalyzer(reading='period'), or plain data"
            )

    def _fewer_block_rows(self, asked, basis, lengths, n_inputs, n_outputs):
        """Block rows asked for, or fewer by default where the record is short."""
        sliding = basis.reading == "sliding"
        least, i = (max(2, basis.window_rows + 2) if sliding else 2), asked
        while (
            self.block_rows is None
            and i > least
            and n_hankel_columns(lengths, i) < 2 * i * (n_inputs + n_outputs)
        ):
            i -= 1
        return i

    def _check_block_rows(self, experiment, lengths, n_inputs, n_outputs):
        """Block rows that the window, the order and the record allow."""
        basis = experiment.basis
        sliding = basis.reading == "sliding"
        asked = self._block_rows_asked(basis)
        i = self._fewer_block_rows(asked, basis, lengths, n_inputs, n_outputs)
        self._check_rank_bound(i, n_outputs)
        # the future inputs, i m rows, are projected out of j = n_rows − 2 i + 1 columns
        if sliding:
            self._check_rows_per_period(basis)
        n_projected = n_inputs + (n_outputs if self.weighting == PREDICTOR else 0)
        need = i * n_projected + 1 + (1 if self.order == "auto" else int(self.order))
        free = self.order == "auto" and self.block_rows is None and not basis.harmonic
        if n_hankel_columns(lengths, i) < need and not (free and sum(lengths) > 1):
            unit, moving = "row", "input(s)"
            way_out = "use a longer record, fewer block rows or a smaller hop"
            if is_lifted(experiment):
                unit, moving = "period", "direction(s) of inputs"
                way_out = "use a longer record, or fewer block rows"
            rows = f"{sum(lengths)} {unit}(s) (n_samples = {len(experiment.base.time)})"
            raise ValueError(
                f"the {experiment.span()} give {rows} to identify from, too few for "
                f"block_rows={i}: at least {need + 2 * i - 1} consecutive {unit}s are needed with "
                f"{n_inputs} {moving}{why_short(experiment.base)}; {way_out}"
            )
        return i

    @staticmethod
    def _check_rows_per_period(basis):
        highest = max(k for _, orders in basis.outputs for k in orders)
        if basis.rows_per_period <= 2 * highest:
            most = basis.samples_per_period // (2 * highest + 1)
            raise ValueError(
                f"hop={basis.hop} reads {basis.rows_per_period} rows a period, too few for "
                f"harmonic {highest}: copies of the modes fold onto the modes; use a hop of at "
                f"most {most}, or reading='period'"
            )

    def _warn_excitation(self, excited, n_moving, experiment):
        """Warn of Hankel matrices of deficient rank, where directions were counted."""
        need = 2 * self.block_rows_ * n_moving
        if excited is not None and excited < need:
            warn(
                f"the inputs in the {experiment.span()} excite {excited} directions, but "
                f"block_rows={self.block_rows_} with {n_moving} input(s) asks for {need}; "
                f"use a richer input or fewer block rows, and trust the order with care",
                ExcitationWarning,
            )

    def _rows_of_predictor(self, factor, lengths, n_inputs, n_outputs, lifted):
        """Block rows after which the predictor has forgotten its state, and the order fits in.

        ``factor(block_rows)`` is the triangular factor of the data. Beyond the directions that
        the inputs excite there are many predictors, whose states are no one's.
        """
        most = self.block_rows_
        while most < MOST_PREDICTOR_ROWS and n_hankel_columns(lengths, most + 1) >= (
            COLUMNS_PER_ROW * (most + 1) * (n_inputs + n_outputs)
        ):
            most += 1
        R = factor(most)
        if not lifted and n_inputs:
            excited = n_excited(R, most, n_inputs)
            if excited < 2 * most * n_inputs:
                most = max(2, excited // (2 * n_inputs))
                warn(
                    f"the inputs excite {excited} directions, so that a predictor may reach back "
                    f"{most} rows and no further: what it has not forgotten by then is lost; use "
                    f"a richer input",
                    ExcitationWarning,
                )
                R = factor(most)
        columns = n_hankel_columns(lengths, most)
        order = 1 if self.order == "auto" else int(self.order)
        rows = rows_remembered(R, most, n_inputs, columns, bool(self.feedthrough) or lifted)
        rows = min(most, max(rows, -(-order // n_outputs)) + ROWS_BEYOND)
        self._check_rank_bound(rows, n_outputs)
        return rows
