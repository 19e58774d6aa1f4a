"""What speaks against a model: each doubt with its figure and the section that shows more."""

from html import escape

import numpy as np
import pandas as pd

from sklearn_hd._opinion import DOUBT
from sklearn_hd._report.page import digits

HARMLESS = ("TimeBaseWarning", "JitterWarning", "ResamplingWarning")  # of how rows were read
ANCHORS = {  # of the section that shows what a warning is about
    "ExcitationWarning": "data",
    "FrequencyMismatchWarning": "harmonics",
    "IdentifiabilityWarning": "modes",
    "InstabilityWarning": "modes",
}
HALF = 0.5  # R² below which a simulation leaves more than it explains
UNSURE = ("ambiguous", "second-order")


def doubts(fitted, validation):
    """Pairs of a text and the anchor of a section.

    Parameters
    ----------
    fitted : Fitted
    validation : Run or None
    """
    found = [
        (text[:1].upper() + text[1:] + ".", ANCHORS.get(kind, "warnings"))
        for kind, text in fitted.told
        if kind not in HARMLESS
    ]
    found += _of_modes(fitted.reducer)
    found += _of_match(fitted.matcher)
    found += _of_residuals(fitted)
    for run, what, anchor in (
        (validation, "the validation record", "validation"),
        (fitted.run, "the record of the fit", "validation"),
    ):
        if run is None:
            continue
        if run.reason is not None:
            found.append((f"{what.capitalize()} was not scored: {run.reason}", anchor))
        elif not run.r2 >= HALF:
            found.append(
                (
                    f"The simulation of {what} leaves more than it explains: "
                    f"R² = {digits(run.r2, 3)}.",
                    anchor,
                )
            )
    return found


def _of_modes(reducer):
    """Modes that the reducer is not sure of."""
    if reducer is None:
        return []
    modes = reducer.modes_
    unsure = modes[modes["verdict"].isin(UNSURE)]
    return [
        (f"The mode at {digits(mode.eigenvalue)} 1/s is {mode.verdict}: {mode.reason}.", "modes")
        for mode in unsure.itertuples()
    ]


def _of_residuals(fitted):
    """Residuals that are no noise, unless the likelihood's deviations allow for them."""
    tests = fitted.tests
    if isinstance(tests, str) or tests["passed"].all() or stands(fitted.matcher):
        return []
    failed = tests[~tests["passed"]]
    worst = failed["share"].idxmax()
    return [
        (
            f"The residuals are not white noise: {len(failed)} of {len(tests)} tests fail "
            f"({', '.join(failed.index)}). The test '{worst}' finds "
            f"{digits(100.0 * failed['share'][worst], 2)} % of their variance to be no noise.",
            "residuals",
        )
    ]


def stands(matcher):
    """Whether a likelihood knows its model's exponents, whatever its residuals are."""
    found = None if matcher is None else matcher.match_.uncertainty
    return found is not None and found.tests is not None and found.doubt is None


def _of_match(matcher):
    """A matched model that is far from the one identified, or not determined by the data."""
    if matcher is None:
        return []
    error, found = matcher.hinf_error_relative_, []
    if error > DOUBT:
        found.append(
            (
                f"The matched model differs from the identified one by {digits(100.0 * error, 3)} "
                f"% (H∞ norm of the error, relative) at "
                f"{digits(matcher.peak_frequency_)} rad/s.",
                "model",
            )
        )
    std = pd.Series(matcher.theta_std_)
    unknown = std.index[np.isinf(std)]
    if len(unknown):
        found.append((f"The record does not determine {', '.join(unknown)}.", "model"))
    return found


def doubts_box(found, checks):
    """The box at the top: doubts, or which checks found none."""
    if not found:
        return f'<div class="box"><p><b>No check found a fault.</b> {escape(checks)}</p></div>'
    items = "".join(
        f'<li>{escape(t)} <a href="#{a}">See {a.capitalize()}.</a></li>' for t, a in found
    )
    many = "one doubt" if len(found) == 1 else f"{len(found)} doubts"
    return (
        f'<div class="box doubt"><p><b>This model may be wrong: {many}.</b></p>'
        f"<ul>{items}</ul></div>"
    )
