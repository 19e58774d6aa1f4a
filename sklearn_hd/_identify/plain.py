"""Plain data: ordinary subspace identification, sample by sample."""

from dataclasses import replace

import numpy as np

from sklearn_hd._checks import LITTLE
from sklearn_hd._fit_checks import check_motion, warn_of_unstable
from sklearn_hd._frame import LTIModel
from sklearn_hd._guards import warn
from sklearn_hd._identify.stages import (
    DEFAULT_BLOCK_ROWS,
    SubspaceFit,
    allowed_block_rows,
    by_gap,
    decompose,
    fewer_block_rows,
    fit_matrices,
    rows_of_predictor,
    subspace_fit,
    warn_of_feedback,
)
from sklearn_hd._identify.statistics import Facts, Records
from sklearn_hd.algorithms.lti.simulation import growth
from sklearn_hd.algorithms.subspace.hankel import n_hankel_columns
from sklearn_hd.algorithms.subspace.input_matrices import input_matrices
from sklearn_hd.algorithms.subspace.order import (
    Comparison,
    differ,
    order_by_wide_gap,
)
from sklearn_hd.algorithms.subspace.projections import share_at_once
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

FARTHEST = 300.0  # e-folds over a segment, beyond which squares of outputs overflow


def read(experiment, settings):
    """Data of an experiment: its rows as they are."""
    facts = Facts.of(experiment, experiment.drive)
    return Records(experiment.drive, experiment.outputs, facts, settings.memory)


def asked_block_rows(basis, settings):
    """Block rows given, or 15."""
    return DEFAULT_BLOCK_ROWS if settings.block_rows is None else int(settings.block_rows)


def identify(data, settings, experiment=None):
    """Identify a model from samples: a SubspaceFit.

    ``data`` are Records, Summed or Partitions. ``experiment`` is given where data are
    in memory; a record too short for dynamics then has a static gain.
    """
    i = _block_rows(data, settings)
    check_motion(data.facts)
    if n_hankel_columns(data.lengths, i) <= i * data.n_inputs:
        return static_gain(data.facts, experiment, settings, i)
    size, scales = data.scales(settings.scale)
    if settings.predictor and settings.block_rows is None:
        i = rows_of_predictor(data, i, size, settings)
    choice = Choice(data, settings, scales, experiment is not None)
    settings = choice.before(i, size)
    decomposition = decompose(data, i, size, settings, choice.order)
    free = choice.feedthrough(decomposition, size)
    fitted = fit_matrices(data, decomposition, size, scales, settings, free)
    fit = subspace_fit(
        decomposition,
        fitted,
        scales,
        data.facts,
        settings,
        free,
        feedthrough_reason=choice.reason,
        tried=choice.tried,
    )
    warn_of_unstable(fit.model, max(data.lengths))
    return fit


class Choice:
    """The order and the feedthrough that the data ask for.

    Inputs and outputs are divided by ``scales`` (m,), (l,). ``in_memory`` says whether
    there are rows to simulate models over; else singular values tell.
    """

    def __init__(self, data, settings, scales, in_memory):
        self.data, self.settings, self.scales = data, settings, scales
        self.simulates = in_memory and data.n_inputs > 0
        self.reason, self._comparison = "", None

    @property
    def tried(self):
        """All models simulated."""
        return () if self._comparison is None else self._comparison.tried

    def before(self, block_rows, size):
        """The settings, with the feedthrough where simulations will not tell: from what rows
        before leave of the outputs.
        """
        asked, i = self.settings.feedthrough, block_rows
        if asked != "auto":
            self.reason = f"feedthrough={asked} was asked for"
        elif self.data.n_inputs == 0:
            self._settle(False, "there are no inputs")
        elif self.settings.predictor or not self.simulates:
            share, words = self._at_once(i, size)
            self._settle(share > 0.0 and not self.settings.predictor, words)
            if share > LITTLE and self.settings.predictor:
                warn_of_feedback(words)
        return self.settings

    def _at_once(self, i, size):
        """Share of the innovations that inputs of their row explain, and the same in words."""
        R, columns = self.data.factor(i, size), n_hankel_columns(self.data.lengths, i)
        share = share_at_once(R, i, self.data.n_inputs, columns)
        words = (
            "inputs explain outputs of their own row" if share > 0.0 else "no input acts at once"
        )
        return share, f"{words}: {share:.2%} of what earlier rows leave of the outputs"

    def _settle(self, free, reason):
        self.settings, self.reason = replace(self.settings, feedthrough=free), reason

    def order(self, found, bound):
        """By a gap of decades, else by what simulations leave, else by any gap."""
        wide = order_by_wide_gap(found.singular_values, found.floor, bound)
        if wide is not None:
            return wide
        if not self.simulates:  # weights amplify noise along some directions, MOESP's do not
            return by_gap(found if self.settings.predictor else found.unweighted(), bound)
        m, n_outputs = self.data.n_inputs, self.data.n_outputs
        most = (sum(self.data.lengths) // 2 - m) * n_outputs // (m + n_outputs + 1)
        comparison = self._compared(found)
        order = comparison.order(max(1, min(bound, most)), bool(self.settings.feedthrough))
        if order is not None:
            return order
        warn(
            f"no model explains the outputs: simulations of all orders up to "
            f"{len(comparison.tried)} leave more than the outputs' own variance, so the singular "
            f"values choose the order; check that outputs follow inputs, with positive delays, and "
            f"that inputs are held between rows",
            IdentifiabilityWarning,
        )
        return by_gap(found, bound)

    def feedthrough(self, decomposition, size):
        """Whether D is free."""
        if self.settings.feedthrough != "auto":
            return self.settings.feedthrough
        comparison, order = self._compared(decomposition.found), decomposition.order
        free, zero = (comparison.simulated(order, D) for D in (True, False))
        if min(free.variance, zero.variance) >= 1.0:
            share, self.reason = self._at_once(decomposition.block_rows, size)
            return share > 0.0
        gain, alike = zero.bic - free.bic, not differ(zero, free)
        self.reason = (
            f"simulations leave {free.share:.4g} of the outputs with D free, {zero.share:.4g} "
            f"with D = 0: the Bayesian information criterion is {abs(gain):.3g} lower with "
            f"{'D free' if gain > 0.0 else 'D = 0'}"
        )
        if gain > 0.0 and alike:
            self.reason += ", but what is left agrees to a hundredth: D is zero"
        return bool(gain > 0.0 and not alike)

    def _compared(self, found):
        """Simulations of models of one decomposition, in the units that it was made in."""
        if self._comparison is None:
            data, (u_scale, y_scale), stable = self.data, self.scales, self.settings.stable
            inputs = [u / u_scale for u in data.inputs]
            outputs = [y / y_scale for y in data.outputs]

            def model(order, feedthrough):
                if self.settings.predictor:
                    return *found.model(order, stable)[:4], None
                A, C = found.state_matrices(order, stable)
                if max(data.lengths) * growth(A) > FARTHEST:
                    return None
                B, D, x0 = input_matrices(A, C, inputs, outputs, feedthrough)
                return A, B, C, D, x0

            self._comparison = Comparison(model, inputs, outputs, self.settings.predictor)
        return self._comparison


def _block_rows(data, settings):
    """Block rows given, or as many as the record allows; a record of few rows has a gain alone."""
    asked = min(asked_block_rows(data.facts.basis, settings), data.most_block_rows)
    if settings.chooses and sum(data.lengths) > 1:
        return fewer_block_rows(asked, 2, data.lengths, data.n_inputs + data.n_outputs)
    return allowed_block_rows(settings, data, asked)


def static_gain(facts, experiment, settings, block_rows):
    """Gain without states, all that a record too short for any dynamics gives."""
    if experiment is None:
        raise ValueError(
            f"the {facts.span} are too few to identify dynamics from "
            f"{len(facts.basis.drive_labels)} input(s); for a static gain, fit all rows at once in "
            f"memory"
        )
    inputs, outputs = experiment.drive, experiment.outputs
    n_outputs = outputs[0].shape[1]
    warn(
        f"the {facts.span} are too few to identify dynamics from {inputs[0].shape[1]} "
        f"input(s): a static gain is fitted; use a longer record",
        ExcitationWarning,
    )
    A, C = np.zeros((0, 0)), np.zeros((n_outputs, 0))
    B, D, x0 = input_matrices(A, C, inputs, outputs, True)
    left = np.vstack(outputs) - np.vstack(inputs) @ D.T
    noise = {}
    if settings.disturbance_model or settings.predictor:
        noise["kalman_gain"] = np.zeros((0, n_outputs))
        noise["innovations_covariance"] = left.T @ left / len(left)
    model = LTIModel(
        A=A,
        B=B,
        C=C,
        D=D,
        dt=facts.sample_time,
        input_names=facts.basis.drive_labels,
        output_names=facts.basis.output_labels,
        feedthrough=True,
        **noise,
    )
    reason = "the record is too short for dynamics, so the model is D alone"
    return SubspaceFit(model, x0, block_rows, 0, feedthrough_reason=reason)
