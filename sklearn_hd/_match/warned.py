"""What a match is warned of: parameters not determined, searches cut short, poor fits."""

import numpy as np
from sklearn.exceptions import ConvergenceWarning

from sklearn_hd._fit_checks import growth_rate, longest_span
from sklearn_hd._warn import warn
from sklearn_hd.exceptions import IdentifiabilityWarning, InstabilityWarning

POOR_MATCH = 1e-2  # relative error of a match between different orders worth a warning
MOST_SYSTEMATIC = 0.01  # share of the variance left in a rest that is not white
POOR_FIT = 0.5  # share of the raw record's variance below which a closed form is not trusted
RUNAWAY = 1e4  # speed of a pole, relative to the model's fastest, that is a feedthrough's
FLOOR = 0.5  # share of the error that fixed entries of D leave, above which they decide it


def warn_realized(found):
    """Of a periodic model in closed form."""
    if not found.physical:
        _warn(
            f"the outputs {list(found.model.output_names)} do not determine the "
            f"{found.model.n_states} states: the model is in Floquet coordinates, in which its "
            f"states have no physical meaning; measure more outputs for that"
        )
    if found.r2 < POOR_FIT:
        _warn(
            f"the periodic model explains only {max(0.0, found.r2):.0%} of the record's variance; "
            f"check order, omega and that the record is long enough, or refine it with "
            f"criterion='output_error'"
        )
    elif found.systematic > MOST_SYSTEMATIC:
        _warn(
            f"the periodic model leaves {found.systematic:.2g} of the record's variance in a rest "
            f"that is no noise (neighbouring samples are alike); check order, omega, the harmonics "
            f"that the structure allows, and whether the response is linear"
        )
    if found.unidentified:
        _warn(
            f"the record does not determine {', '.join(found.unidentified)} (only some "
            f"combinations of them): of all values that fit, the smallest are taken; let inputs "
            f"change at more phases of the period, or give G and Q fewer harmonics"
        )


def warn_growing(periodic, model, experiment):
    """Of a periodic model that grows e-fold within a segment, where that identified does not."""
    longest, basis = longest_span(experiment), experiment.basis
    if growth_rate(model) * longest > 1.0:  # it has been warned of
        return
    radius = periodic.sampled(basis.samples_per_period).spectral_radius
    folds = np.log(max(radius, 1e-300)) * longest * basis.omega / (2.0 * np.pi)
    if folds > 1.0:
        _warn(
            f"the periodic model matched has a Floquet multiplier of size {radius:.4g}, by which "
            f"it grows {np.exp(min(folds, 700.0)):.3g} times over the longest segment, where the "
            f"model identified is stable: noise has moved it; refine it with criterion="
            f"'output_error' and structure=HarmonicStructure(), or change the order",
            InstabilityWarning,
        )


def warn_matched(result, criterion, poles, affine):
    """Of a match in a norm of an affine structure to a model with some poles."""
    n_found, n_wanted = len(poles), affine.n_states
    if n_found != n_wanted and result.relative_error > POOR_MATCH:
        _warn(
            f"the model has {n_found} states, the structure {n_wanted}, and the match leaves a "
            f"relative error of {result.relative_error:.2g}; the structure may not be that of the "
            f"system, or SpuriousModeReducer(n_states={n_wanted}) is needed"
        )
    if result.feedthrough_floor > FLOOR * result.hinf_error and not result.exact:
        _warn(
            f"the feedthrough of the model cannot be that of the structure: entries of D that are "
            f"fixed leave {result.feedthrough_floor / result.hinf_error:.0%} of the error, at "
            f"infinite frequency, whatever the parameters; free them, or weigh high frequencies "
            f"less (output_weights)"
        )
    fastest = np.abs(poles).max(initial=0.0)
    speed, halfway = (
        np.abs(affine.poles(share * result.theta)).max(initial=0.0) for share in (1.0, 0.5)
    )
    held_by_parameters = abs(speed - halfway) > 0.01 * speed
    if speed > RUNAWAY * fastest > 0 and held_by_parameters and not result.exact:
        _warn(
            f"the match has a pole of {speed:.2g} rad/s, {speed / fastest:.1g} times the fastest "
            f"of the model: the best one lies at infinity, where that pole is a feedthrough; free "
            f"entries of D, or give bounds to the parameters that grew"
        )
    if result.unidentified:
        _warn(
            f"these outputs do not determine {', '.join(result.unidentified)} (only some "
            f"combinations of them): fix some, share a name, or measure more outputs"
        )
    if not result.converged:
        name = "H-infinity" if criterion == "hinf" else "least-squares"
        _warn(
            f"the {name} match stopped after {result.n_iter} steps at a relative error of "
            f"{result.relative_error:.3g}, with {result.left:.2g} of it left where "
            f"{result.tolerance:g} counts as converged; raise max_iter or n_starts",
            ConvergenceWarning,
        )


def warn_closed_loop():
    """Of maximum likelihood of a simulation, after a model identified in closed loop."""
    warn(
        "criterion='output_error' simulates the record and takes all that is left for noise of the "
        "sensors; where disturbances move the machine and feedback answers, this is biased, and "
        "weighting='pbsid' has told that inputs may answer to outputs: use criterion='hinf', "
        "or ignore this where nothing but sensors is noisy",
        IdentifiabilityWarning,
    )


def warn_refined(result):
    """Of a fit by maximum likelihood."""
    if result.unidentified:
        _warn(
            f"the record does not determine {', '.join(result.unidentified)} (only some "
            f"combinations of them): their standard deviation is infinite; fix some, share a name, "
            f"or use a richer record"
        )
    if not result.converged:
        _warn(
            f"maximum likelihood stopped after {result.n_iter} iterations; another step would "
            f"lower the sum of squares by {result.relative_decrease:.2g} of itself; raise max_iter",
            ConvergenceWarning,
        )


def _warn(text, category=IdentifiabilityWarning):
    warn(text, category)
