"""The next record: inputs that determine the Floquet exponents best within a budget."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted

from sklearn_hd._checks import check_choice, check_count, check_numbers, check_positive
from sklearn_hd._excitation import TOO_LARGE
from sklearn_hd._guards import one_blas_thread, within_range
from sklearn_hd._records.data import read_experiment
from sklearn_hd._records.likelihood import RecordData, with_loads
from sklearn_hd.algorithms.likelihood.forms import Form, interpolating
from sklearn_hd.algorithms.likelihood.input_design import (
    ExponentBound,
    Multisines,
    Steps,
    exchange,
)
from sklearn_hd.algorithms.likelihood.predictor import as_records, simulate
from sklearn_hd.algorithms.signals.fourier import harmonic_labels
from sklearn_hd.matching import StructuredMatcher
from sklearn_hd.structures import HarmonicStructure
from sklearn_hd.systems import LTPSystem

KINDS = {"steps": Steps, "multisine": Multisines}
LEAST_ROWS = 16  # a period in the search: edges lie on these
SAMPLES = 64  # a period, of a system that has none of its own
MOST_HARMONICS = 8  # of F and G, taken for unknown, of an LTPSystem whose structure is not given
TAIL = 1e-2  # of the coefficients' norm, which may be left out then
N_PHASES = 8  # of a period, at which pulses ask what is known
LACKS = 2.0  # times the doubt that the designed record leaves


@dataclass(frozen=True, eq=False)
class InputDesign:
    """Result of :func:`design_input`.

    Parameters
    ----------
    inputs : DataFrame, shape (n_samples, n_inputs)
        Changes of the inputs about their trim, ready to fly, held from sample to sample. Time in
        seconds; the first row is at ψ = 0.
    outputs : DataFrame, shape (n_samples, n_outputs)
        Response of the model to them, about the trim; check that this is a small motion.
    exponents : DataFrame, shape (n_states, 3 or 6)
        Floquet exponents of the model, 1/s, and ``std_real`` and ``std_imag``, the smallest
        standard deviations of an unbiased estimate from the new record. With a record at hand also
        ``std_real_at_hand``, ``std_imag_at_hand`` and ``gain``, the factor by which the magnitude
        of the deviations falls.
    phases : DataFrame, shape (8 n_inputs, 1 or 2)
        Index: input and azimuth in degrees. ``designed``: unknown share (root mean square), after
        the new record, of the motion that a short pulse of that input at that azimuth causes.
        ``at_hand``: the same after the record at hand.
    energy : float
        ∫ Σ (u / amplitude)² dt, seconds.
    n_evaluations : int
        Number of inputs compared.

    References
    ----------
    Ljung (1999), System Identification, section 13.3 (informative experiments).

    Examples
    --------
    >>> from sklearn_hd.systems import mathieu
    >>> found = design_input(
    ...     mathieu(), amplitude=1.0, length=30.0, noise_std=0.1, samples_per_period=16, n_trials=5
    ... )
    >>> found.exponents.columns.tolist()
    ['exponent', 'std_real', 'std_imag']
    """

    inputs: pd.DataFrame
    outputs: pd.DataFrame
    exponents: pd.DataFrame
    phases: pd.DataFrame
    energy: float
    n_evaluations: int

    @property
    def lacking(self):
        """What the record at hand lacks, in words; empty if it lacks nothing or was not given."""
        if "at_hand" not in self.phases:
            return ""
        hand, new = self.phases["at_hand"], self.phases["designed"]
        worse = self.phases.index[hand > LACKS * new]
        words = []
        for name in worse.unique("input"):
            degrees = worse[worse.get_level_values("input") == name].get_level_values("azimuth")
            most = hand.loc[name].loc[degrees].max()
            known = f"its motion there is known only to {most:.2g} of its size"
            known = known if most < 1.0 else "its motion there is unknown"
            where = "ψ = " + ", ".join(f"{each:g}°" for each in degrees)
            where = "all azimuths" if len(degrees) == N_PHASES else where
            words.append(f"{name} at {where} ({known})")
        return "; ".join(words)


@one_blas_thread
@within_range
def design_input(
    model,
    *,
    amplitude,
    length,
    kind="steps",
    energy=None,
    X=None,
    noise_std=None,
    structure=None,
    exponents=None,
    samples_per_period=None,
    quiet_periods=4,
    n_trials=300,
    random_state=0,
):
    """Inputs within a budget whose record determines the Floquet exponents best.

        min over u of Π_i σ_i(u),   σ_i² = (∂λ_i/∂θ) I(u)⁻¹ (∂λ_i/∂θ)ᴴ,   |u| ≤ amplitude

    I(u) is the Fisher matrix of all parameters θ of the model, with white noise on the outputs and
    an unknown initial state, so σ is the Cramér-Rao bound of the new record. It is computed for
    the given model: design, fly, identify, and design again. The search ends in a local optimum; a
    longer one (``n_trials``), or other seeds, may find a better one.

    Parameters
    ----------
    model : StructuredMatcher, Pipeline that ends in one, or LTPSystem
        Fitted, with a :class:`~sklearn_hd.HarmonicStructure` whose states are outputs.
    amplitude : float, sequence of float, or dict
        Largest change of each input, in its units (a dict: by name).
    length : float
        Seconds, including the quiet periods.
    kind : {"steps", "multisine"}, default="steps"
        ``"steps"``: held levels −amplitude, 0 or amplitude, with free edges; doublets and 3-2-1-1
        are examples. ``"multisine"``: up to forty lines with free amplitudes and phases, up to two
        cycles per period.
    energy : float, optional
        Bound of ∫ Σ (u / amplitude)² dt in seconds: the time for which one input may stand at its
        amplitude. By default there is none.
    X : DataFrame or ndarray, shape (n_samples, n_inputs), optional
        Inputs of the record at hand, as for ``predict``; for an LTPSystem changes about the trim,
        with a whole number of samples per period.
    noise_std : float, sequence of float, or dict, optional
        Standard deviation of the noise of each output (a dict: by name). By default that of a
        model fitted with ``criterion="output_error"``. A common factor changes all σ, not the
        inputs found.
    structure : HarmonicStructure, optional
        Unknown part of the system. By default that of the matcher; for an LTPSystem all
        coefficients of F and G up to the harmonics that they have, P and Q known.
    exponents : sequence of int, optional
        Indices of the exponents that count, from the rightmost (0) leftwards; all by default.
    samples_per_period : int, optional
        That of the model by default, 64 for an LTPSystem.
    quiet_periods : int, default=4
        Periods at rest at the beginning, which show the trim.
    n_trials : int, default=300
        Number of changes tried. Edges lie on sixteenths of a period, or finer if F has many
        harmonics.
    random_state : int, RandomState or None, default=0
        Seed of the search.

    Returns
    -------
    design : InputDesign
        With ``inputs``, a DataFrame to fly, the expected deviations, and what the record at hand
        lacks.

    Raises
    ------
    NotFittedError
        If the model has not been fitted.
    ValueError
        If an argument is not understood, the budget excites nothing, or no input within it
        determines the exponents; the message names the undetermined parameters.

    References
    ----------
    Mehra (1974), IEEE Transactions on Automatic Control 19(6), 753-768.
    Fedorov (1972), Theory of Optimal Experiments, chapter 3 (exchange).
    Jategaonkar (2006), Flight Vehicle System Identification, chapter 2 (doublets, 3-2-1-1).

    Examples
    --------
    A doublet of two periods, and steps that determine more with the same energy:

    >>> from sklearn_hd.systems import mathieu
    >>> system = mathieu(damping=0.3)
    >>> t = system.period / 16 * np.arange(16 * 20)
    >>> doublet = np.where(t < 4 * system.period, 0.0, np.where(t < 5 * system.period, 1.0, -1.0))
    >>> doublet[t >= 6 * system.period] = 0.0
    >>> X = pd.DataFrame({"u": doublet}, index=t)
    >>> found = design_input(
    ...     system, amplitude=1.0, length=20 * system.period, energy=2 * system.period, X=X,
    ...     noise_std=0.05, samples_per_period=16, n_trials=40,
    ... )
    >>> bool(found.exponents["gain"].min() > 1.5)
    True
    """
    check_choice("kind", kind, tuple(KINDS))
    n_trials = check_count("n_trials", n_trials, 0, "300 is usual")
    quiet = check_count("quiet_periods", quiet_periods, 0, "4 show the trim")
    plant = _plant(model, structure, noise_std, samples_per_period)
    amplitude = _amplitudes(amplitude, plant.input_names)
    n_periods = _whole_periods(length, quiet, plant)
    rng, which = check_random_state(random_state), _which(exponents, plant)
    coarse = plant.at(plant.rows_of_search)
    plant.check_growth(coarse.form, quiet + n_periods)
    rows = coarse.form.n_phases
    family = KINDS[kind](n_periods * rows, len(amplitude), rows)
    most = np.inf
    if energy is not None:
        most = check_positive("energy", energy, "seconds", "that of a doublet is the time it lasts")

    def record(levels, per_period):
        """Inputs in their units, after the quiet periods, within the energy."""
        used = np.sum(levels**2) * plant.period / per_period
        scale = amplitude * min(1.0, np.sqrt(most / used)) if used > 0.0 else amplitude
        return np.vstack([np.zeros((quiet * per_period, len(amplitude))), levels * scale])

    def cost(levels):
        u = record(levels, rows)
        return coarse.cost(plant.with_load(u), which)

    best, lowest, n_evaluations = exchange(family, cost, n_trials, rng)
    fine = plant.at(plant.n_phases)
    u = record(family.inputs(best, plant.n_phases // rows), plant.n_phases)
    if not np.isfinite(lowest):
        raise ValueError(plant.why_unknown(fine, u))
    used = np.sum((u / amplitude) ** 2) * plant.period / plant.n_phases
    at_hand = None if X is None else plant.at_hand(model, X)
    told, lacking = plant.compared(fine, coarse, u, at_hand)
    _check_told(told, float(used))
    return InputDesign(*plant.flown(u), told, lacking, float(used), n_evaluations)


def _check_told(told, used):
    """Raise ValueError if no exponent would be known to better than its own size."""
    spread = np.hypot(told["std_real"], told["std_imag"]).to_numpy()
    size = np.abs(told["exponent"].to_numpy())
    if np.all(spread > size):
        k = int(np.argmin(spread))
        raise ValueError(
            f"the best inputs found excite nothing above the noise: they hold {used:.3g} s of "
            f"energy at their amplitude, and leave the exponent {told['exponent'].iloc[k]:.4g} 1/s "
            f"known to ± {spread[k]:.2g} 1/s; raise energy, amplitude or length, or lower the noise"
        )


# ---- what is to be identified ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Plant:
    """A periodic system, its unknown part, and how it is measured."""

    structure: object
    theta: np.ndarray
    omega: float
    n_phases: int
    sigma: np.ndarray
    input_names: tuple
    output_names: tuple
    n_loads: int  # harmonics of unknown loads; −1 if there are none

    @property
    def period(self):
        return 2.0 * np.pi / self.omega

    @property
    def rows_of_search(self):
        """The fewest samples per period that resolve F(ψ), a divisor of all."""
        least = max(LEAST_ROWS, 4 * self.structure.n_harmonics)
        divisors = [d for d in range(1, self.n_phases + 1) if self.n_phases % d == 0]
        return next((d for d in divisors if d >= least), self.n_phases)

    def at(self, n_phases):
        """The bound at fewer samples per period, whose noise averages those in between."""
        sigma = self.sigma * np.sqrt(n_phases / self.n_phases)
        return ExponentBound(self.form(n_phases), self.theta, sigma)

    def form(self, n_phases):
        return Form(self.structure, self.omega, n_phases)

    def with_load(self, u, size=1.0):
        """Inputs, with an additional one of some size if loads are also unknown."""
        return u if self.n_loads < 0 else np.hstack([u, np.full((len(u), 1), size)])

    def check_growth(self, form, n_periods):
        """Raise ValueError if the motion grows too large."""
        radius = form.radius(form.response(self.theta, sensitivities=False))
        if radius > 1.0 and not n_periods * np.log(radius) < np.log(TOO_LARGE):
            raise ValueError(
                f"the model is unstable (largest multiplier {radius:.3g}), and its motion grows by "
                f"more than {TOO_LARGE:g} within {n_periods} periods; design a shorter record, or "
                f"close a control loop around the machine first"
            )

    def why_unknown(self, bound, u):
        """Why the exponents are not determined, and the way out."""
        names = bound.information([(self.with_load(u), None, 0)]).unidentified
        return (
            f"no input tried within this budget determines the exponents: the outputs do not "
            f"separate the parameters {list(names[:6])}{' and others' if len(names) > 6 else ''}; "
            f"raise length, drive further inputs, or give structure=HarmonicStructure(...) with "
            f"fewer harmonics or known entries"
        )

    def flown(self, u):
        """Inputs and simulated outputs as frames."""
        dt = self.period / self.n_phases
        index = pd.Index(dt * np.arange(len(u)), name="time")
        form = self.form(self.n_phases)
        response = form.response(self.theta, sensitivities=False)
        (record,) = as_records([(self.with_load(u, 0.0), None, 0)], form.n_outputs)
        y = simulate(response, record, np.zeros(form.n_states))[1]
        return (
            pd.DataFrame(u, index, list(self.input_names)),
            pd.DataFrame(y, index, list(self.output_names)),
        )

    def compared(self, fine, coarse, u, at_hand):
        """Tables of the exponents and of the knowledge at each phase."""
        found = fine.information([(self.with_load(u), None, 0)])
        std = fine.std_of(found)
        pulses, index = self._pulses(coarse.form.n_phases)
        table = pd.DataFrame(
            {"exponent": fine.exponents, "std_real": std.real, "std_imag": std.imag}
        )
        phases = pd.DataFrame({"designed": coarse.doubts(found, pulses)}, index)
        if at_hand is not None:
            before = fine.std_of(at_hand)
            table["std_real_at_hand"], table["std_imag_at_hand"] = before.real, before.imag
            table["gain"] = np.abs(before) / np.abs(std)
            phases["at_hand"] = coarse.doubts(at_hand, pulses)
        return table, phases

    def _pulses(self, n_phases):
        """Short pulses of each input at each phase, and the index of a table of them."""
        m, width = len(self.input_names), max(1, n_phases // N_PHASES)
        pulses = []
        for j, phase in np.ndindex(m, N_PHASES):
            u = np.zeros((8 * n_phases, self.structure.n_inputs))  # followed over 8 periods
            first = phase * n_phases // N_PHASES
            u[first : first + width, j] = 1.0
            pulses.append(u)
        degrees = 360.0 * np.arange(N_PHASES) / N_PHASES
        names = ["input", "azimuth"]
        return pulses, pd.MultiIndex.from_product([self.input_names, degrees], names=names)

    def at_hand(self, model, X):
        """What a record of the inputs X shows about the parameters."""
        if isinstance(model, LTPSystem):
            segments, form = self._segments(X), self.form(self.n_phases)
        else:
            segments, form = self._segments_of_fit(model, X)
        return ExponentBound(form, self.theta, self.sigma).information(segments)

    def _segments(self, X):
        """Records of an LTPSystem, with a whole number of samples per period."""
        experiment = read_experiment(X)
        names = tuple(map(str, experiment.basis.drive_labels))
        if len(names) != len(self.input_names):
            raise ValueError(
                f"X has the columns {list(names)}, but the system has the inputs "
                f"{list(self.input_names)}; give one column for each"
            )
        segments = []
        for u, time in zip(experiment.inputs, experiment.times(), strict=True):
            psi = self.omega * time
            rows = psi * self.n_phases / (2.0 * np.pi)
            off = np.max(np.abs(rows - rows[0] - np.arange(len(u))), initial=0.0)
            if not max(off, abs(rows[0] - round(rows[0]))) < 1e-3:
                raise ValueError(
                    f"X has {2.0 * np.pi / (self.omega * experiment.base.sample_time):.6g} samples "
                    f"per period, but must have samples_per_period={self.n_phases}, with the first "
                    f"one a whole number of samples after ψ = 0; set samples_per_period, or "
                    f"resample X"
                )
            segments.append((u, None, round(rows[0])))
        return segments

    def _segments_of_fit(self, model, X):
        """Records as the matcher reads them, and the form at their clock."""
        matcher, frame = _matcher(model), X
        if matcher is not model:
            frame = model[:-1].transform(X)
        experiment = matcher._experiment(frame)
        some = [np.zeros((len(u), len(self.output_names))) for u in experiment.inputs]
        experiment = replace(experiment, outputs=some, delays=None)  # inputs as they arrive
        loaded = matcher.match_.sampled if self.n_loads >= 0 else None
        data = RecordData.of(experiment, True, loaded)
        segments = [(u, None, where) for u, _, where in data.segments]
        form = Form(self.structure, self.omega, data.n_phases)
        if any(np.ndim(where) for *_, where in segments):
            return segments, interpolating(form, self.theta)
        return segments, Form(self.structure, self.omega, round(data.n_phases))


def _plant(model, structure, noise_std, samples_per_period):
    """The plant of a model of either kind."""
    if structure is not None and not isinstance(structure, HarmonicStructure):
        raise ValueError(f"structure={structure!r} is not a HarmonicStructure; give one, or None")
    if isinstance(model, LTPSystem):
        return _of_system(model, structure, noise_std, samples_per_period)
    matcher = _matcher(model)
    check_is_fitted(matcher)
    match, basis = matcher.match_, matcher.basis_
    if matcher.criterion == "prediction_error":
        raise ValueError(
            "the model was fitted with criterion='prediction_error', where gusts move its states, "
            "but this bound counts only the noise on the outputs; fit with "
            "criterion='output_error', or give its ltp_ and noise_std for a bound without gusts"
        )
    if match.periodic is None or not (match.periodic.physical or structure is not None):
        raise ValueError(
            "design_input needs a linear time-periodic model whose states are outputs; fit with "
            "structure=HarmonicStructure() and as many states as outputs, or give an LTPSystem, "
            "such as ltp_ of the fitted step, with noise_std"
        )
    periodic, given = match.periodic, structure or matcher.structure or HarmonicStructure()
    names = periodic.state_names, periodic.input_names, periodic.output_names
    resolved = given.resolve(*names, {key: periodic.highest(key) for key in "FGP"})
    theta, n_loads = resolved.nearest(periodic.coefficients), -1
    if basis.reading == "sample":
        n_loads = basis.most_loads
        resolved = with_loads(resolved, n_loads)
        theta = np.append(theta, np.zeros(resolved.n_parameters - len(theta)))
    if noise_std is None:
        if match.uncertainty is None:
            raise ValueError(
                "this model was fitted in a norm, so its noise is unknown; give noise_std, or fit "
                "with criterion='output_error'"
            )
        noise_std = match.uncertainty.noise_std
    count = samples_per_period or round(basis.samples_per_period)
    return _assembled(resolved, theta, periodic.omega, count, noise_std, names, n_loads)


def _of_system(system, structure, noise_std, samples_per_period):
    if noise_std is None:
        raise ValueError(
            "the noise of an LTPSystem is unknown; give noise_std, the standard deviation of each "
            "output's sensor noise (only the ratios change the inputs found)"
        )
    names = system.state_names, system.input_names, system.output_names
    F, G, P, Q = system.fourier_coefficients(4 * MOST_HARMONICS)
    if structure is None:
        known = {"P": _as_known(P), "Q": _as_known(Q)}
        structure = HarmonicStructure(_n_harmonics("F", F), _n_harmonics("G", G), **known)
    resolved = structure.resolve(*names, dict.fromkeys("FGP", MOST_HARMONICS))
    theta = resolved.nearest(np.block([[F, G], [P, Q]]))
    count = SAMPLES if samples_per_period is None else samples_per_period
    return _assembled(resolved, theta, system.omega, count, noise_std, names, -1)


def _assembled(structure, theta, omega, count, noise_std, names, n_loads):
    count = check_count("samples_per_period", count, 4, "64 resolve a flap")
    if not names[1]:
        raise ValueError(
            "the model has no inputs, so nothing can be designed; identify with the inputs that "
            "the next record may move"
        )
    sigma = _by_name("noise_std", noise_std, names[2], "the standard deviation of the noise")
    return _Plant(structure, theta, omega, count, sigma, tuple(names[1]), tuple(names[2]), n_loads)


def _matcher(model):
    """The matcher itself, or that at the end of a Pipeline."""
    last = model[-1] if hasattr(model, "steps") else model
    if not isinstance(last, StructuredMatcher):
        raise ValueError(
            f"model={model!r} is neither a StructuredMatcher, nor a Pipeline that ends in one, nor "
            f"an LTPSystem; give one of these"
        )
    return last


def _n_harmonics(name, coefficients):
    """Harmonics of a matrix, except for a hundredth of its norm."""
    squares = np.sum(coefficients**2, axis=(1, 2))
    for k in range(MOST_HARMONICS + 1):
        if np.sum(squares[2 * k + 1 :]) <= TAIL**2 * np.sum(squares):
            return k
    raise ValueError(
        f"{name} of the system has more than {MOST_HARMONICS} harmonics; state what is unknown: "
        f"structure=HarmonicStructure(F=..., G=...)"
    )


def _as_known(coefficients):
    """Coefficients as a dict of numbers."""
    last = np.flatnonzero(np.any(coefficients != 0.0, axis=(1, 2))).max(initial=0)
    labels = harmonic_labels(range((last + 1) // 2 + 1))
    return dict(zip(labels, coefficients, strict=False))


# ---- the budget ----------------------------------------------------------------------------------


def _by_name(what, values, names, meaning):
    """One positive number for each name."""
    if isinstance(values, Mapping):
        if set(values) != set(names):
            raise ValueError(f"{what}={dict(values)!r} must name each of {list(names)}")
        values = [values[name] for name in names]
    given = np.atleast_1d(np.asarray(values, dtype=object)).ravel()
    if len(given) not in (1, len(names)):
        raise ValueError(
            f"{what} has {len(given)} values; give one, or one for each of {list(names)}"
        )
    for name, value in zip(names, np.broadcast_to(given, len(names)), strict=True):
        check_numbers("finite", f"it is {meaning} of {name}", **{what: value})
    given = np.broadcast_to(given.astype(float), len(names))
    if not np.all(given > 0.0):
        raise ValueError(
            f"{what}={given.tolist()} must be positive: it is {meaning} of {list(names)}"
        )
    return given


def _amplitudes(amplitude, names):
    try:
        return _by_name("amplitude", amplitude, names, "the largest change")
    except ValueError as error:
        raise ValueError(
            f"{error}; an input with amplitude zero does not move, so drop it"
        ) from None


def _whole_periods(length, quiet, plant):
    """Whole periods after the quiet ones."""
    check_positive("length", length, "seconds", "it is the length of the whole record")
    n_periods = int(np.floor(length / plant.period + 1e-9)) - quiet
    if n_periods < 1:
        raise ValueError(
            f"length={length:g} s leaves no period for inputs after quiet_periods={quiet}; a "
            f"period lasts {plant.period:.4g} s, so give {(quiet + 1) * plant.period:.4g} s or more"
        )
    return n_periods


def _which(exponents, plant):
    """Places of the exponents that count."""
    if exponents is None:
        return slice(None)
    n = plant.structure.n_states
    places = np.atleast_1d(np.asarray(exponents))
    if not (len(places) and places.dtype.kind in "iu" and np.all((places >= 0) & (places < n))):
        raise ValueError(
            f"exponents={exponents!r} must be indices among the {n} exponents; 0 is the rightmost"
        )
    return places
