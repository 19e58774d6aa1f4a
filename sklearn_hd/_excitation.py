"""What predictions need beyond what the record of a fit showed: effects of inputs, and the orbit.

Models of whole periods describe inputs only in the directions within the period in which they
moved (:class:`~sklearn_hd.algorithms.signals.fourier.InputDirections`). Models at samples have
B(ψ) and D(ψ) of few harmonics, which the outputs of whole turns may determine from edges at few
phases: with A and C known, outputs are linear in them, and least squares give their covariance.
What a fit leaves is no white noise where states or nonlinearity are missing; for residuals of any
spectrum S the covariance is at most max S / mean S times that for white noise (Grenander and
Rosenblatt, *Statistical Analysis of Stationary Time Series*, 1957, chapter 7).
"""

from dataclasses import dataclass
from itertools import chain

import numpy as np
from scipy import linalg
from scipy.signal import welch
from scipy.stats import chi2

from sklearn_hd._guards import searches, warn
from sklearn_hd._readings.sample import MOST_LOADS
from sklearn_hd._records.data import lifted_periods
from sklearn_hd.algorithms.likelihood.likelihood import eliminate_states, updated_factor
from sklearn_hd.algorithms.linalg.rounding import DEPENDENT, HALF
from sklearn_hd.algorithms.linalg.triangular import column_sizes
from sklearn_hd.algorithms.periodic.harmonic_balance import evaluate_harmonics
from sklearn_hd.algorithms.periodic.periodic_innovations import input_slopes
from sklearn_hd.algorithms.periodic.speed import LEAST_TURNS, orbit_share
from sklearn_hd.algorithms.signals.fourier import (
    AT_ONCE,
    InputDirections,
    fitted_harmonics,
    harmonic_functions,
)
from sklearn_hd.exceptions import ExcitationWarning, IdentifiabilityWarning

MOST_OUTSIDE = 1e-3  # of the inputs' energy within the period
NOISE = 1e-4  # of it, which may be noise
NOTABLE = 1e-2  # of the motion predicted, below which its standard deviation is no matter
MOST_OFF = 0.1  # of the motion predicted, that the orbit may be off by
LARGEST = 1e10  # operations: of longer records, and wider models, nothing is said
N_STRETCHES = 8  # of a segment, half over each other, whose periodograms are averaged
BY_CHANCE = 0.01  # of spectra of white noise have a larger peak than is taken for none
TOO_LARGE = 1e8  # times the outputs: a simulation that grows so far tells nothing


@dataclass(frozen=True, eq=False)
class Excitation:
    """What the record of a fit shows about the effect of inputs."""

    names: tuple  # of str: of the inputs
    drive: tuple  # of str: of the input that each of the drive is made of
    # within the period, of models of whole periods; else of the samples
    directions: InputDirections
    n_harmonics: int  # of B(ψ) and D(ψ)
    information: object  # Information or None: of models at the samples of a machine that turns

    @classmethod
    def of(cls, experiment, simulators, n_harmonics):
        """Of the experiment of a fit, and the model's simulators over it; None without inputs."""
        names = tuple(experiment.basis.input_signals)
        if not names:
            return None
        by_period = _by_period(experiment, simulators)
        noise = NOISE if by_period else 0.0
        loads = experiment.basis.reading == "sample"
        directions = InputDirections.of(_lifted(experiment, by_period), noise, about_mean=loads)
        information = None
        if experiment.basis.harmonic and simulators[0].steps_at_samples:
            information = Information.of(experiment, simulators, n_harmonics)
        drive = tuple(experiment.basis.drive_signals)
        return cls(names, drive, directions, n_harmonics, information)

    def warn(self, experiment, simulators):
        """Warn of inputs whose effect is needed, but was not shown."""
        if any(searches()):
            return
        by_period = _by_period(experiment, simulators)
        share, each = self.directions.outside(_lifted(experiment, by_period))
        if share > MOST_OUTSIDE:
            where = (
                "at phases or in directions within the period in which the inputs never moved in "
                "the record of the fit, and a model of whole periods is valid only for those seen "
                "there; put StructuredMatcher(structure=HarmonicStructure()) behind it, or record "
                "inputs that change at these phases"
                if by_period
                else "in which inputs move separately, as they never did in the record of the fit: "
                "that record determines only their joint effect; record each input moving by itself"
            )
            warn(
                f"{share:.2g} of the energy of the inputs {self._most(each)} is motion {where}",
                ExcitationWarning,
            )
        elif self.information is not None:
            doubt, each = self.information.doubt(experiment, simulators, self.n_harmonics)
            if doubt > max(NOTABLE, self.information.left):
                warn(
                    f"the inputs {self._most(each)} move at phases of the period, or in "
                    f"directions, in which the record of the fit shows little of their effect: by "
                    f"the record alone, the standard deviation of the predicted motion may be "
                    f"{f'{doubt:.2g}' if doubt < 1.0 else 'more than all'} of that motion, while "
                    f"the fit left {self.information.left:.2g}; record inputs that change at these "
                    f"phases, too, each by itself, or allow G fewer harmonics",
                    ExcitationWarning,
                )

    def _most(self, each):
        """Names of the inputs with the largest share."""
        names = self.names if len(each) == len(self.names) else self.drive
        most = [name for name, own in zip(names, each, strict=True) if 2.0 * own >= max(each)]
        return list(dict.fromkeys(most))


@dataclass(frozen=True, eq=False)
class Information:
    """What a record shows about B(ψ) and D(ψ), with A and C known."""

    root: np.ndarray  # (k, r): of the covariance of their coefficients, in parts of the noise
    input_scale: np.ndarray  # (m,): of the inputs
    scale: np.ndarray  # (l,): of the outputs
    answer: float  # energy of what inputs make, in parts of theirs
    # what no coefficients explain, root mean square, as far as it may act like white noise
    noise: float
    left: float  # all of that, in parts of what inputs make

    @classmethod
    @np.errstate(over="ignore", invalid="ignore")
    def of(cls, experiment, simulators, n_harmonics):
        """Of a model at samples; None of one that grows too large, or is too wide."""
        outputs = experiment.outputs
        n_values, n_rows = sum(y.size for y in outputs), sum(map(len, outputs))
        scale = column_sizes(np.vstack(outputs)) / np.sqrt(n_rows)
        factors, rests, energy, squares = [], [], 0.0, 0.0
        for segment in zip(simulators, experiment.phases, outputs, strict=True):
            simulator, psi, y = segment
            factor, left = None, []
            for some, u, slopes in _slopes(simulator, psi, n_harmonics):
                slopes, forced = np.split(slopes / scale[:, None], [-2], axis=-1)
                n_columns = slopes.shape[-1] + 1
                grown = np.max(np.abs(forced), initial=0.0)
                enough = n_columns > simulator.model.n_states + 1
                if not (enough and grown < TOO_LARGE and n_values * n_columns**2 < LARGEST):
                    return None
                target = forced[..., 1:] - (y[some] / scale)[..., None]
                columns = np.concatenate([slopes, target], axis=-1).reshape(-1, n_columns).T
                factor = np.zeros((n_columns, n_columns)) if factor is None else factor
                factor = updated_factor(factor, columns)
                rest = (target[..., 0] + forced[..., 0]).reshape(1, -1)
                left.append(np.concatenate([columns[: simulator.model.n_states], rest]))
                energy += np.sum(forced[..., 0] ** 2)
                squares = squares + np.sum(u**2, axis=0)
            factors.append(factor)
            rests.append(_beside_start(np.hstack(left)).reshape(-1, len(scale)))
        if not energy > 0.0 or not np.all(np.isfinite(factors)):
            return None
        system = eliminate_states(factors, simulator.model.n_states)
        steps = system.steps
        singular = np.maximum(steps.singular, DEPENDENT)  # below, nothing is told
        root = steps.adjoint.T / singular / steps.size[:, None]
        rest = np.sum(system.R[:, -1] ** 2) - steps.promised
        noise, left = (np.sqrt(max(float(rest), 0.0) / each) for each in (n_values, energy))
        noise *= np.sqrt(spectral_peak(rests))
        input_scale = np.sqrt(np.where(squares > 0.0, squares, n_rows) / n_rows)
        answer = energy / np.sum(squares / input_scale**2)
        return cls(root, input_scale, scale, answer, noise, left)

    @np.errstate(over="ignore", invalid="ignore")
    def doubt(self, experiment, simulators, n_harmonics):
        """Standard deviation of what inputs make in parts of it, and each input's variance.

        Or in parts of what they would make as in the fit, where that is less: a wrong prediction
        may be far too large.
        """
        variance = energy = pushed = own = 0.0
        m, left = len(self.input_scale), LARGEST / self.root.size
        roots = self.root.reshape(len(self.root) // m, m, -1)
        n = simulators[0].model.n_states
        segments = zip(simulators, experiment.phases, strict=True)
        for _, u, slopes in chain.from_iterable(_slopes(*each, n_harmonics) for each in segments):
            slopes, forced = np.split(slopes / self.scale[:, None], [-2], axis=-1)
            each = slopes[..., n:].reshape(*slopes.shape[:2], -1, m)
            each = np.einsum("tlkj,kjr->jtlr", each, roots, optimize=True)
            own = own + np.sum(each**2, axis=(1, 2, 3))
            variance += np.sum(np.sum(each, axis=0) ** 2)
            energy += np.sum(forced[..., 0] ** 2)
            pushed += np.sum((u / self.input_scale) ** 2)
            left -= forced.size
            if left < 0.0:
                break
        energy = min(energy, self.answer * pushed)
        return (self.noise * np.sqrt(variance / energy) if energy > 0.0 else 0.0), own


def warn_of_orbit(simulators, outputs):
    """Warn of an orbit that may be off by more than a tenth of the motion predicted about it."""
    model = simulators[0].model
    off = getattr(model, "orbit_deviation", None)
    if off is None or any(searches()) or not any(map(_inputs_move, simulators)):
        return
    about = [
        y - model.outputs_at_rest(simulator.psi)
        for simulator, y in zip(simulators, outputs, strict=True)
    ]
    motion, whole = (np.sqrt(np.mean(np.vstack(each) ** 2, axis=0)) for each in (about, outputs))
    share = off / np.where(motion > HALF * whole, motion, np.inf)  # of rounding none
    most = int(np.argmax(share))
    if share[most] > MOST_OFF:
        warn(
            f"the record of the fit tells {model.output_names[most]!r} of the machine at rest only "
            f"to within {off[most]:.2g}, and the motion predicted about that is "
            f"{motion[most]:.2g} (root mean squares): noise hides this orbit, or large motions "
            f"have shifted it; take only differences of predictions, or fit a longer record, "
            f"smaller motions, or one with turns at rest",
            IdentifiabilityWarning,
        )


def warn_of_another_orbit(measured, simulated, at_rows, time, experiment):
    """Warn of a waveform that a record repeats with every turn and the model does not have.

    It has to be most of what the simulation leaves, more than the motion, and a notable part of
    the orbit itself. Means do not count: a bad model leaves them, too.

    ``measured`` and ``simulated`` (n_samples, l) are without the model's orbit, and
    ``at_rows`` is as measured. ``time`` is that of the experiment's grid in seconds.
    """
    basis, unit = experiment.basis, np.max(np.abs(at_rows))
    few = len(time) < LEAST_TURNS * basis.samples_per_period
    if few or any(searches()) or not 0.0 < unit < np.inf:
        return
    if not np.max(np.abs(simulated)) <= TOO_LARGE * unit:
        return
    n_harmonics = min(MOST_LOADS, int(0.5 * (basis.samples_per_period - 1)))
    left, psi = (measured - simulated) / unit, basis.azimuth(time)
    waves = fitted_harmonics([(np.hstack([left, at_rows / unit]), psi)], n_harmonics)
    waves[0] = 0.0
    apart, orbit = np.hsplit(evaluate_harmonics(waves, psi), 2)
    motion = measured / unit - apart
    apart, orbit, motion = (np.std(each, axis=0) for each in (apart, orbit, motion))
    for k in np.flatnonzero(apart > np.maximum(motion, MOST_OFF * orbit)):
        if orbit_share([(None, left[:, [k]], time)], basis.omega, n_harmonics) < 0.5:  # not most
            continue
        warn(
            f"the output {experiment.output_names[k]!r} of the record scored has a waveform that "
            f"repeats with every turn and that the model does not have: it is "
            f"{unit * apart[k]:.2g}, the motion beside it {unit * motion[k]:.2g} (standard "
            f"deviations); the record may be about another orbit: check the unit and sign of the "
            f"output, the order of all, and the times (or azimuth), whose zero has to be at the "
            f"same phase as at fit",
            IdentifiabilityWarning,
        )
        break


def _inputs_move(simulator):
    """Whether the inputs of a segment are other than those of a machine at rest."""
    model, u = simulator.model, simulator.drive
    if model.trim_in_inputs and not np.any(u != u[:1]):  # they hold a trim
        return False
    moving = model.moving(u, simulator.psi) if model.trim_in_inputs else u
    return bool(np.any(np.abs(moving) > HALF * np.max(np.abs(u), initial=0.0)))


def spectral_peak(segments):
    """The largest part of a spectrum over its mean, beyond what chance makes of white noise.

    By the mean periodogram of eight stretches of the longest segment, half over each other
    (Welch, 1967): of white noise it is χ² with 36 K² / (19 K − 1) degrees of freedom.

    It is the largest of all outputs, and at least 1. It is 1 where a segment is too
    short to tell.

    Examples
    --------
    >>> noise = np.random.default_rng(0).standard_normal((4000, 1))
    >>> wave = 3.0 * np.cos(np.arange(4000) * 0.3)[:, None]
    >>> round(spectral_peak([noise]), 1), round(spectral_peak([noise + wave]))
    (1.0, 62)
    """
    rows = max(segments, key=len)
    length = 2 * len(rows) // (N_STRETCHES + 1)
    if length < 10:
        return 1.0
    _, spectrum = welch(rows, nperseg=length, detrend="constant", axis=0)
    spectrum, degrees = spectrum[1:], 36.0 * N_STRETCHES**2 / (19.0 * N_STRETCHES - 1.0)
    mean = spectrum.mean(axis=0)
    shares = spectrum.max(axis=0) / np.where(mean > 0.0, mean, np.inf)
    chance = chi2.isf(BY_CHANCE / len(spectrum), degrees) / degrees
    return float(max(1.0, np.max(shares, initial=0.0) / chance))


def _beside_start(columns):
    """What the last of some columns is beside the others, which are of the initial state."""
    *start, rest = columns
    if not np.all(np.isfinite(columns)):
        return rest
    return rest - np.transpose(start) @ linalg.lstsq(np.transpose(start), rest)[0]


def _by_period(experiment, simulators):
    """Whether the model is one of whole periods."""
    return experiment.basis.reading == "period" and not simulators[0].steps_at_samples


def _lifted(experiment, by_period):
    """Inputs as rows of whole periods, or of single samples."""
    if by_period:
        return lifted_periods(experiment, experiment.inputs)
    return [u[:, None] for u in experiment.inputs]


def _slopes(simulator, psi, n_harmonics):
    """Samples of pieces of a segment, their inputs, and outputs by the inputs' coefficients.

    As :func:`~sklearn_hd.algorithms.periodic.periodic_innovations.input_slopes`.
    """
    end, at = None, simulator.at_samples(slice(1))
    width = (2 * n_harmonics + 1) * at.inputs.shape[1] + 1
    length = max(1, AT_ONCE // (sum(at.rows.outputs.shape[1:]) ** 2 * width))
    for first in range(0, len(psi), length):
        some = slice(first, first + length)
        at = simulator.at_samples(some)
        functions = harmonic_functions(psi[some], range(n_harmonics + 1))
        slopes, end = input_slopes(at.rows, at.inputs, functions, end)
        yield some, at.inputs, slopes
