"""Contents of a file for a fitted step: its model, its uncertainty, and its surroundings."""

import numpy as np

from sklearn_hd._frame import SampleModel
from sklearn_hd.systems.export import lti_contents, ltp_contents


def contents(step, n_phases):
    """All that a file has of a fitted step, by name."""
    periodic, basis = _periodic(step), step.basis_
    constant = getattr(step, "system_", None)
    if periodic is None and constant is None:
        constant = step.system_  # which says why there is none
    found = {} if constant is None else lti_contents(constant)
    if periodic is not None:
        found |= ltp_contents(periodic, n_phases)
    match = getattr(step, "match_", None)
    uncertainty = getattr(match, "uncertainty", None)
    if uncertainty is not None:
        found["exponents"] = np.asarray(uncertainty.exponents, dtype=complex)
        found["exponents_std"] = np.asarray(uncertainty.exponents_std, dtype=complex)
    delays = step.model_.delays
    if delays is not None:  # seconds, by input and by output; the matrices are without them
        found |= {"input_delay": delays.inputs, "output_delay": delays.outputs}
    if not basis.harmonic:
        return found
    found |= {"omega": basis.omega, "sample_time": basis.sample_time}
    trims = {"input_trim": basis.input_trim, "output_trim": basis.output_trim}
    trims = {name: trim for name, trim in trims.items() if trim is not None}
    if trims:
        count = n_phases if basis.reading == "sample" else basis.samples_per_period
        found["trim_psi"] = psi = 2.0 * np.pi * np.arange(count) / count
        if basis.reading == "sample":  # which has their Fourier coefficients
            trims = {n: basis.waveform(trim, psi / basis.omega) for n, trim in trims.items()}
        found |= trims
        found["trim_input_names"] = list(basis.input_signals)
        found["trim_output_names"] = [name for name, _ in basis.outputs]
    sampled = getattr(match, "sampled", None) or step.model_
    if isinstance(sampled, SampleModel) and sampled.n_loads >= 0:
        found["forced_response"] = sampled.innovations.forced_response(sampled.n_loads)
    return found


def _periodic(step):
    """The periodic system of a step, or None."""
    if isinstance(step.model_, SampleModel):
        return None if step.model_.time_invariant else step.model_.to_ltp()
    return getattr(step, "ltp_", None)
