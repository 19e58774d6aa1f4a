"""Contents of a file for a fitted step: its model, its uncertainty, and its surroundings."""

import numpy as np
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._sample_model import SampleModel
from sklearn_hd.systems.export import lti_contents, ltp_contents, write

__all__ = ["Exported"]


class Exported:
    """A step whose model can leave Python."""

    def export(self, path, *, n_phases=64):
        """Write the model to a file for MATLAB (.mat) or any program (.json).

        The file has the periodic system, where there is one, and the time-invariant matrices A,
        B, C, D of ``system_``; names and units as in the record; exponents with their standard
        deviations; waveforms of the trim, and the forced periodic response; delays in seconds.
        :func:`~sklearn_hd.systems.load_model` reads JSON back.

        Parameters
        ----------
        path : str or path-like
            Ends in ``.json`` or ``.mat``; a file that is there is replaced.
        n_phases : int, default=64
            Azimuths in a period at which periodic matrices are tabulated, too.

        Raises
        ------
        NotFittedError
            Before ``fit``.
        ValueError
            If the suffix is another, or a number is not finite.
        OSError
            If the file cannot be written.
        """
        check_is_fitted(self)
        write(_contents(self, n_phases), path)


def _contents(step, n_phases):
    """All that a file has of a fitted step, by name."""
    periodic, basis = _periodic(step), step.basis_
    constant = getattr(step, "system_", None)
    if periodic is None and constant is None:
        constant = step.system_  # which says why there is none
    contents = {} if constant is None else lti_contents(constant)
    if periodic is not None:
        contents |= ltp_contents(periodic, n_phases)
    match = getattr(step, "match_", None)
    uncertainty = getattr(match, "uncertainty", None)
    if uncertainty is not None:
        contents["exponents"] = np.asarray(uncertainty.exponents, dtype=complex)
        contents["exponents_std"] = np.asarray(uncertainty.exponents_std, dtype=complex)
    delays = step.model_.delays
    if delays is not None:  # seconds, by input and by output; the matrices are without them
        contents |= {"input_delay": delays.inputs, "output_delay": delays.outputs}
    if not basis.harmonic:
        return contents
    contents |= {"omega": basis.omega, "sample_time": basis.sample_time}
    trims = {"input_trim": basis.input_trim, "output_trim": basis.output_trim}
    trims = {name: trim for name, trim in trims.items() if trim is not None}
    if trims:
        count = basis.samples_per_period
        contents["trim_psi"] = 2.0 * np.pi * np.arange(count) / count
        contents |= trims
        contents["trim_input_names"] = list(basis.input_signals)
        contents["trim_output_names"] = [name for name, _ in basis.outputs]
    sampled = getattr(match, "sampled", None) or step.model_
    if isinstance(sampled, SampleModel) and sampled.n_loads >= 0:
        contents["forced_response"] = sampled.innovations.forced_response(sampled.n_loads)
    return contents


def _periodic(step):
    """The periodic system of a step, or None."""
    if isinstance(step.model_, SampleModel):
        return None if step.model_.time_invariant else step.model_.to_ltp()
    return getattr(step, "ltp_", None)
