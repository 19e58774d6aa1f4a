"""ω of a record: as given, or as the record tells it where the given one is surely off."""

import numpy as np

from sklearn_hd._readings import READINGS
from sklearn_hd._records.data import sample
from sklearn_hd._warn import warn
from sklearn_hd.algorithms.periodic.speed import measured_speed
from sklearn_hd.exceptions import FrequencyMismatchWarning

__all__ = ["settled_omega"]

ROWS_PER_TURN = 24  # looked at: they tell 12 harmonics of the orbit
SLIGHT = 1e-4  # of the energy of the motion, 1 % of its size: what is less is no matter


def settled_omega(analyzer, inputs, outputs, timing):
    """The fundamental frequency at which a record is analysed, rad/s.

    Parameters
    ----------
    analyzer : HarmonicAnalyzer
        Asked for ``omega`` and ``azimuth`` alone.
    inputs : Signals
    outputs : ndarray, shape (n_rows, n_outputs), or None
    timing : Timing

    Returns
    -------
    omega : float
        The mean speed by the azimuth where there is one.
    """
    if analyzer.azimuth is not None:
        return inputs.mean_speed(analyzer.azimuth)[1]
    omega, step = float(analyzer.omega), inputs.base.sample_time
    samples = 2.0 * np.pi / omega / step
    if outputs is None or not np.isfinite(samples) or samples <= 2.0:
        return omega
    basis = _samples(inputs, omega, max(1, int(samples / ROWS_PER_TURN)), timing)
    sampling, u, y = sample(inputs, basis, outputs)
    segments = list(zip(u, y, (piece.grid for piece in sampling.pieces), strict=True))
    found = measured_speed(segments, omega, basis.most_loads)
    if found is None:
        return omega
    if found.moved > SLIGHT:
        _warn_of_another(found, omega)
    return found.omega


def _samples(inputs, omega, hop, timing):
    """A basis of samples with their azimuths, some of which are left out."""
    step = inputs.base.sample_time * hop
    return READINGS["sample"](
        omega=omega,
        sample_time=step,
        samples_per_period=2.0 * np.pi / omega / step,
        window="boxcar",
        hop=hop,
        inputs=tuple((name, (0,)) for name in inputs.names),
        outputs=(),
        timing=timing,
    )


def _warn_of_another(found, omega):
    off = omega / found.omega - 1.0
    warn(
        f"the data repeat themselves at {found.omega:.9g} ± {found.std:.2g} rad/s, not at "
        f"omega={omega:.9g} rad/s, which is {abs(off):.2{'%' if abs(off) > 1e-4 else 'g'}} "
        f"{'more' if off > 0.0 else 'less'}: the azimuth would go astray by {found.turns:.2g} "
        f"turns, {np.sqrt(found.moved):.2g} of the size of the motion; {found.omega:.9g} is used "
        f"instead; set omega={found.omega:.9g}, or check the clock",
        FrequencyMismatchWarning,
    )
