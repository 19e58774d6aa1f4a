"""Random calls: estimators and pipelines on random signals, functions, systems, structures."""

import itertools
import pickle
import reprlib
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from fuzz_promises import DOCUMENTED, Violation, check_worded
from fuzzed_data import DT, SAMPLES_PER_PERIOD, chance, draw_signals, pick
from scipy.sparse import issparse
from sklearn.base import clone
from sklearn.exceptions import NotFittedError
from sklearn.metrics import mean_absolute_error, r2_score
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicFrame,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.signals.fundamental import estimate_omega
from sklearn_hd.model_selection import (
    BlockSplit,
    PeriodBlockSplit,
    fit_percent,
    fit_percent_scorer,
    simulation_scorer,
    smallest_within_one_standard_error,
)
from sklearn_hd.systems import (
    FourierMatrix,
    LTPSystem,
    PeriodicSystem,
    estimate_harmonic_transfer_function,
)

OMEGA = 2.0 * np.pi / (SAMPLES_PER_PERIOD * DT)
NONSENSE = [None, "x", "", -1, 0, 1.5, np.nan, np.inf, True, [1, 2], {}, (), 1j, 10**400, object]
NUMBERS = [-1.0, 0.0, 1e-310, 1e-3, 1.0, 1e3, 1e300]


@dataclass
class Call:
    """Something to call, what it is given, and what must not change."""

    name: str
    perform: object
    data: tuple = ()
    told: dict = field(default_factory=dict)
    also: tuple = ()  # exceptions that this entry documents beside those of all

    def __str__(self):
        text = reprlib.Repr()
        text.maxother = text.maxstring = 400
        return f"{self.name}; {self.told}"


def draw_call(rng):
    draw = rng.choice([draw_steps, draw_function, draw_system], p=[0.75, 0.13, 0.12])
    return draw(rng)


def one_of(rng, good, bad=NONSENSE, share=0.02):
    return pick(rng, bad) if chance(rng, share) else pick(rng, good)


def some(rng, options):
    """A few of the parameters, at values that are mostly allowed."""
    names = [name for name in options if chance(rng, 0.25)]
    return {name: one_of(rng, options[name]) for name in names}


# ---- steps --------------------------------------------------------------------------------------


def draw_analyzer(rng):
    options = {
        "input_harmonics": [0, 0, 0, 1, 1, 1, {"u0": 0}, {"u0": [0, 2]}, {"y0": 1}],
        "output_harmonics": [0, 0, 0, 1, 1, 1, 4, {"y0": [1]}, {"y0": []}],
        "window": [side + w for side in ("", "centred-") for w in ("boxcar", "triangle", "hann")],
        "load_harmonics": [None, None, None, 0, 1, 3],
        "reading": ["sliding", "sliding", "sliding", "period", "sample", "auto"],
        "hop": [None, None, None, 1, 2, 2, 4, 3],
        "trim_span": [None, (0.0, 2.0), (0.0, 3), (0.0, 1e9), (0.0, np.inf), (-np.inf, np.inf)],
        "sample_time": [None, DT, DT, DT, 1.0],
        "azimuth": [None, None, None, None, None, "u0", "psi", "psi"],
        "time_origin": [None, "2026-05-01", "2026-05-01", "2026-05-01", pd.Timestamp.max],
        "missing": ["raise", "gap", "gap", 2 * DT, 1e9],
        "small_signal": [None, None, None, "odd", "extrapolate"],
    }
    omega = one_of(rng, [OMEGA] * 20 + [0.9 * OMEGA, 1e-3, 3.0, 1e6, 1e-300, 1e300])
    params = some(rng, options)
    if params.get("azimuth") is not None and chance(rng, 0.9):
        omega = None
    return HarmonicAnalyzer(omega, **params)


def draw_moesp(rng):
    options = {
        "order": ["auto", "auto", 1, 1, 2, 2, 3, 3, 6, 40],
        "block_rows": [None, None, None, 3, 6, 10, 12, 20, 10**6],
        "weighting": ["n4sid", "cva", "pbsid", "pbsid"],
        "disturbance_model": [True, True, False],
        "feedthrough": [True, False],
        "scale": [True, False],
        "warmup": [None, DT, 3.0, 1e-300, 1e300],
    }
    return MOESPRegressor(**some(rng, options))


def draw_reducer(rng, estimator=None):
    options = {
        "n_states": [None, None, 1, 2, 3, 7],
        "method": ["truncate", "residualize", "both"],
        "warmup": [None, 1.0],
    }
    return SpuriousModeReducer(estimator, **some(rng, options))


def draw_matcher(rng, estimator=None):
    options = {
        "criterion": ["hinf", "least_squares", "output_error"],
        "random_state": [0, 7, None],
        "warmup": [None, 1.0],
        "input_noise": [None, 0.1, {"u0": 0.1}],
        "output_weights": [None, 2.0, [1.0, 2.0], {"y0": 3.0}],
        "input_weights": [None, 0.5, {"u0": 1e300}],
    }
    params = some(rng, options)
    params |= {"n_starts": one_of(rng, [0, 1]), "max_iter": one_of(rng, [1, 5, 10])}
    structure = pick(rng, [None, draw_structure, draw_structure, draw_harmonic_structure])
    if structure is not None:
        structure = structure(rng)
    return StructuredMatcher(estimator, structure=one_of(rng, [structure]), **params)


def draw_cells(rng, rows, columns):
    cells = rng.standard_normal((rows, columns)).astype(object)
    texts = ["a", "-b", "2*a", "1 - a/2", np.nan, np.nan, 0, "a*b", "1/a", "", None, 1e300, np.inf]
    for place in np.ndindex(rows, columns):
        if chance(rng, 0.5):
            cells[place] = pick(rng, texts if chance(rng, 0.1) else texts[:7])
    return cells


def draw_structure(rng):
    n, m, p = (int(k) for k in rng.integers(1, 4, 3))
    if chance(rng, 0.5):
        return MatrixStructure(np.full((n, n), np.nan), np.full((n, m), np.nan))
    C = draw_cells(rng, p, n) if chance(rng, 0.5) else None
    A = draw_cells(rng, n, n if chance(rng, 0.97) else n + 1)
    known = {
        "initial": [None, {"a": 1.0}, {"z": 1.0}, "a"],
        "bounds": [None, {"a": (0, None)}, {"a": (2, 1)}, {"a": 3}],
        "fixed": [None, {"b": 1.0}, {"b": np.nan}, {"A[0,0]": 2}],
    }
    return MatrixStructure(A, draw_cells(rng, n, m), C, **some(rng, known))


def draw_harmonic_structure(rng):
    matrices = [None, None, 0, 1, 2, {"0": [[np.nan]]}, {"1c": [["k"]]}, {"2x": [[1]]}]
    params = {"F": one_of(rng, [0, 1]), "G": one_of(rng, [0, 1])}  # else hundreds of parameters
    params |= {name: one_of(rng, matrices) for name in "FGPQ" if chance(rng, 0.2)}
    states = one_of(rng, [None, None, None, ["y0"], ["y0", "y1"], ["a"]])
    return HarmonicStructure(**params, states=states)


def draw_estimator(rng):
    """A step alone, or a pipeline of some of the steps, mostly in their order."""
    kind = rng.choice(
        ["analyzer", "moesp", "reducer", "matcher", "analyzed", "reduced", "matched", "any"],
        p=[0.12, 0.2, 0.1, 0.06, 0.2, 0.17, 0.1, 0.05],
    )
    if kind == "analyzer":
        return draw_analyzer(rng)
    if kind == "moesp":
        return draw_moesp(rng)
    if kind == "reducer":
        return draw_reducer(rng, one_of(rng, [draw_moesp(rng)]))
    if kind == "matcher":
        return draw_matcher(rng, one_of(rng, [draw_moesp(rng)]))
    steps = [draw_analyzer(rng), draw_moesp(rng)]
    if kind in ("reduced", "any") or (kind == "matched" and chance(rng, 0.6)):
        steps.append(draw_reducer(rng))
    if kind in ("matched", "any"):
        steps.append(draw_matcher(rng))
    if kind == "any":
        steps = [steps[k] for k in rng.permutation(len(steps))]
    return Pipeline([(f"step{k}", step) for k, step in enumerate(steps)])


def draw_steps(rng):
    try:
        estimator = draw_estimator(rng)
    except Exception as error:  # a structure that cannot be
        return _raising(error)
    X, y = draw_signals(rng)
    if isinstance(X, pd.DataFrame) and getattr(first_step(estimator), "azimuth", None) == "psi":
        X = X.assign(psi=turning(rng, len(X)))
    rest = np.random.default_rng(rng.integers(2**32))
    if isinstance(estimator, MOESPRegressor) and chance(rng, 0.05):
        X = None
    told = {"X": _described(X), "y": _described(y)}
    if isinstance(estimator, MOESPRegressor) and chance(rng, 0.25):
        perform = lambda said: _stream(estimator, X, y, rest)  # noqa: E731
        return Call(f"{estimator!r} in chunks", perform, (X, y), told)
    perform = lambda said: _use(estimator, X, y, rest, said)  # noqa: E731
    return Call(repr(estimator), perform, (X, y), told)


def first_step(estimator):
    return estimator[0] if isinstance(estimator, Pipeline) else estimator


def turning(rng, n):
    """Azimuth of a rotor, as it should be or otherwise."""
    psi = OMEGA * DT * np.arange(n) * (1.0 + 0.05 * rng.uniform())
    return pick(rng, [psi, psi, psi + 0.2 * np.sin(0.1 * psi), psi % (2 * np.pi), np.rad2deg(psi)])


def _raising(error):
    def perform(said):
        raise error

    return Call("a structure", perform)


def _described(data):
    if isinstance(data, pd.DataFrame):
        columns = [f"{name!r} {dtype}" for name, dtype in data.dtypes.items()]
        return f"frame of {len(data)} rows, {columns}, {data.index[:3]!r} …"
    return reprlib.repr(data)


def _use(estimator, X, y, rng, said):
    """Fit, fit again, and ask for everything."""
    fitted = clone(estimator)
    fitted.fit(X, y)
    _check_fits_alike(estimator, fitted, X, y)
    asked = [
        _ask_again,
        _ask_for_prediction,
        _ask_for_prediction_ahead,
        _ask_for_score,
        _ask_for_transform,
    ]
    for ask in asked:
        _answered(ask, fitted, X, y, rng, said)
    return "fitted"


def _answered(ask, fitted, X, y, rng, said):
    """Whatever is asked of a fitted estimator may be refused, in words."""
    try:
        ask(fitted, X, y, rng, said)  # with the warnings that the asking itself brings
    except NotFittedError as error:
        raise Violation(f"not fitted after fit: {error}") from error
    except DOCUMENTED as error:
        check_worded(error)


def _model(fitted):
    last = fitted[-1] if isinstance(fitted, Pipeline) else fitted
    return getattr(last, "model_", None)


def _check_fits_alike(estimator, fitted, X, y):
    model = _model(fitted)
    random = any(v is None for k, v in estimator.get_params().items() if "random_state" in k)
    if model is None or random:
        return
    again = _matrices(_model(clone(estimator).fit(X, y)))
    for name, found in _matrices(model).items():
        if again[name].tobytes() != found.tobytes():
            raise Violation(f"{name} differs from fit to fit")
        if not np.isfinite(found).all():
            raise Violation(f"{name} is not finite")


def _matrices(model):
    """The matrices of a model by name, of samples as Fourier coefficients."""
    found = getattr(model, "innovations", None)
    if found is None:
        return {name: getattr(model, name) for name in "ABCD"}
    return {name: getattr(found, name) for name in ("coefficients", "gain", "covariance")}


def _ask_again(fitted, X, y, rng, warned):
    pickle.loads(pickle.dumps(fitted))
    repr(fitted), fitted.get_feature_names_out()


def _ask_for_prediction(fitted, X, y, rng, warned):
    if not hasattr(fitted, "predict"):
        return
    predicted = fitted.predict(X)
    _check_prediction(fitted, predicted, warned)
    n = _model(fitted).n_states
    x0 = pick(
        rng,
        [None, np.zeros(n), [10**400] * n, rng.standard_normal((1, n)), np.full(n, np.nan), "x", {},
         1e300, [[]], np.full(n, 1e300), pd.Series(np.ones(n)), {"a": np.ones(n)},
         np.ones((n, n, n)), [1j] * n],
    )  # fmt: skip
    _check_prediction(fitted, fitted.predict(X, x0=x0), warned)


def _ask_for_prediction_ahead(fitted, X, y, rng, warned):
    """Pipelines do not hand it on: of a last step alone."""
    if not hasattr(fitted, "predict_ahead"):
        return
    horizon = one_of(rng, [1, 1, 2, 50, 10**9], share=0.1)
    _check_prediction(fitted, fitted.predict_ahead(X, y, horizon=horizon), warned)


def _check_prediction(fitted, predicted, warned):
    values = np.asarray(predicted, dtype=float)
    steps = [step for _, step in fitted.steps] if isinstance(fitted, Pipeline) else [fitted]
    gaps = any(getattr(step, "missing", "raise") != "raise" for step in steps)
    gaps |= any(
        str(kind) in ("float32", "Float32") for kind in getattr(steps[-1], "target_dtypes_", [])
    )
    if not np.isfinite(values).all() and not warned and not gaps:
        raise Violation("predicts values that are not finite, and has warned of nothing")


def _ask_for_score(fitted, X, y, rng, warned):
    if not hasattr(fitted, "score"):
        return
    score = fitted.score(X, y)
    n = len(y)
    weights = [None, np.ones(n), np.zeros(n), rng.uniform(size=n), -np.ones(n), np.ones(n + 1),
               np.full(n, np.nan), "x", [10**400] * n, 1e300 * np.ones(n),
               1e-310 * np.ones(n)]  # fmt: skip
    weighed = score
    last = fitted[-1] if isinstance(fitted, Pipeline) else fitted
    if last is fitted:
        weighed = fitted.score(X, y, sample_weight=pick(rng, weights))
    scorer = pick(
        rng,
        [fit_percent_scorer(), fit_percent_scorer(0), fit_percent_scorer("y0"),
         fit_percent_scorer(7), simulation_scorer(mean_absolute_error, greater_is_better=False),
         simulation_scorer(r2_score)],
    )  # fmt: skip
    largest = np.nanmax(np.abs(np.asarray(y, dtype=float)))
    values = [score, weighed]
    if largest < 1e75:  # whose squares a metric can add up
        values.append(scorer(fitted, X, y))
    for value in values:
        if not np.isfinite(value) and not warned:
            raise Violation(f"score is {value}, and nothing was warned of")


def _ask_for_transform(fitted, X, y, rng, warned):
    frame = fitted.transform(X)
    if len(frame) != len(X) or not isinstance(frame, HarmonicFrame):
        raise Violation("transform changes the rows, or makes no HarmonicFrame")
    if isinstance(fitted, HarmonicAnalyzer):
        fitted.inverse_transform(frame)
        fitted.inverse_transform(pd.DataFrame(frame))
    small = len(frame.columns) <= 4  # else the match is of hundreds of parameters
    other = pick(rng, [draw_moesp, draw_reducer, draw_matcher if small else draw_moesp])(rng)
    lost = pd.DataFrame(pd.concat([pd.DataFrame(frame)], axis=1))
    clone(other).fit(lost if chance(rng, 0.3) else frame, y)


def _stream(estimator, X, y, rng):
    """partial_fit, chunk by chunk."""
    stream = clone(estimator)
    n = max(min(len(_rows(X)), len(_rows(y))), 1)
    cuts = [0, *np.unique(rng.integers(1, n + 1, int(rng.integers(1, 5)))).tolist(), n]
    for a, b in itertools.pairwise(cuts):
        stream.partial_fit(*(_part(z, slice(a, b)) for z in (X, y)))
    if hasattr(stream, "model_"):
        _check_prediction(stream, stream.predict(X), warned=False)
        return "fitted"
    return "done"


def _part(data, rows):
    """Some rows of the data; all where they have none."""
    if hasattr(data, "iloc"):
        return data.iloc[rows]
    return (
        data[rows]
        if isinstance(data, list) or (isinstance(data, np.ndarray) and data.ndim)
        else data
    )


# ---- functions ----------------------------------------------------------------------------------


def draw_function(rng):
    X, y = draw_signals(rng)
    omega = one_of(rng, [OMEGA, OMEGA, OMEGA, 3.0, 1e-3, 1e300])
    split = {
        "n_splits": [2, 3, 5, 100],
        "gap": [0, 1, 10],
        "trim_span": [None, (0.0, 2.0), (3, 1)],
        "sample_time": [None, DT, 1e300],
        "azimuth": [None, None, None, "u0"],
        "time_origin": [None, "2026-05-01"],
    }
    harmonic = {
        "periods_per_segment": [None, 1, 4, 10**6],
        "window": ["hann", "boxcar", ("tukey", 0.2), ("x", 1)],
        "overlap": [0.0, 0.5, 0.99, 1.0],
        "sample_time": [None, DT],
        "time_origin": [None, "2026-05-01"],
    }
    params, given = some(rng, split), some(rng, harmonic)
    n_harmonics, weight = one_of(rng, [0, 1, 3]), pick(rng, [None, np.ones(len(_rows(X))), "x", -1])
    table = {
        f"split{k}_test_score": pick(
            rng, [np.ones(3), np.array([1.0, np.nan, 2.0]), rng.normal(size=3)]
        )
        for k in range(int(rng.integers(0, 4)))
    }
    table |= {
        "mean_test_score": np.ones(3),
        "params": [{"order": one_of(rng, [1, 2, 3])} for _ in range(3)],
        "param_order": np.arange(3),
    }
    n, size = len(_rows(X)), pick(rng, [1.0, 1e-100, 1e100])
    first, second = size * rng.standard_normal((2, n, 1))
    second = one_of(rng, [second, first, 0.0 * first], [second[1:], second + np.nan, second + 1j])
    share = one_of(rng, [None, 0.5, 1e300])
    period = one_of(rng, [DT])

    periods = PeriodBlockSplit(**{"omega": omega} | params)
    rows = BlockSplit(**{name: params[name] for name in ("n_splits", "gap") if name in params})
    splitter = pick(rng, [periods, rows])

    def split_rows(said):
        for train, test in splitter.split(X, y):
            if np.intersect1d(train, test).size or not len(test):
                raise Violation("blocks overlap, or are empty")
        return "done"

    def transfer(said):
        estimate_harmonic_transfer_function(X, y, omega, n_harmonics, **given)
        return "done"

    def percent(said):
        _finite(fit_percent(first[:, :1], second[:, :1], sample_weight=weight))
        return "done"

    def rule(said):
        smallest_within_one_standard_error(table, test_share=share)
        return "done"

    def frequency(said):
        n = int(rng.integers(1, 400))
        u, z = rng.standard_normal((n, 1)), rng.standard_normal((n, 2))
        _finite(estimate_omega([u], [z], period, OMEGA).omega)
        return "done"

    perform = pick(rng, [split_rows, split_rows, transfer, percent, rule, frequency])
    told = {"X": _described(X), "y": _described(y), "omega": omega, "split": splitter,
            "table": table, "given": given, "N": n_harmonics,
            "weight": reprlib.repr(weight)}  # fmt: skip
    return Call(perform.__name__, perform, (X, y), told)


def _rows(data):
    """Something as long as the data, which may have no length."""
    known = isinstance(data, pd.DataFrame | pd.Series | list) or getattr(data, "ndim", 0)
    return data if known and not issparse(data) else [data]


def _finite(values):
    if not np.isfinite(values).all():
        raise Violation(f"not finite, and no warning: {reprlib.repr(values)}")


# ---- systems and structures ---------------------------------------------------------------------


def draw_matrix(rng, rows, columns):
    """A matrix, Fourier coefficients or a callable, mostly of the size asked for."""
    if chance(rng, 0.04):
        texts = [
            value for value in NONSENSE if not callable(value)
        ]  # what those do is the caller's
        return pick(rng, [*texts, np.zeros((0, 0)), np.zeros((2, 1, 1)), "abc", [[1], [1, 2]]])
    size = pick(rng, NUMBERS) if chance(rng, 0.15) else 1.0
    M = size * rng.standard_normal((2 * int(rng.integers(0, 3)) + 1, rows, columns))
    if chance(rng, 0.06):
        M.flat[int(rng.integers(M.size))] = pick(rng, [np.nan, np.inf, 1e300, 1e-310])
    if chance(rng, 0.3):
        return M[0]
    return FourierMatrix(M) if chance(rng, 0.3) and np.isfinite(M).all() else M


def _hardening(x, u, t):
    with np.errstate(over="ignore", invalid="ignore"):  # an overflow of the caller's own
        return np.cos(t) - x - 0.1 * x**3 + u[:1]


def draw_system(rng):
    n, m, p = (int(k) for k in rng.integers(1, 4, 3))
    F, G = draw_matrix(rng, n, n), draw_matrix(rng, n, m)
    P, Q = (draw_matrix(rng, p, k) if chance(rng, 0.4) else None for k in (n, m))
    omega = one_of(rng, [1.0, 2.0, 2.0, 2 * np.pi, 50.0, 1e-2])
    N = one_of(rng, [0, 1, 2])
    t = DT * np.arange(int(rng.integers(1, 60)))
    t = one_of(
        rng, [t, t, t, t + 1e6, t * 1e-300], [t[::-1], t * 0, t * np.nan, "t", None, t[None]]
    )
    u = rng.standard_normal((np.size(t), m))
    mild = one_of(rng, [u, u[None]])
    u = one_of(rng, [u, u, u * 1e150, u[None]], [u[1:], u * np.nan, "u", None, u * 1j])
    x0 = one_of(rng, [None, np.ones(n)], [np.ones(n + 1), "x", np.full(n, np.nan)])
    frequencies = one_of(rng, [[0.0], [0.5, 1.0], [1e300]], [[np.nan], "x", [[1.0]], [], None, 1j])
    dt = one_of(rng, [None, 0.1, True])
    start = one_of(rng, [0.0, 1.0, 1e6])
    told = {"F": F, "G": G, "P": P, "Q": Q, "omega": omega, "N": N, "x0": x0, "dt": dt}
    told |= {"frequencies": frequencies, "t": _described(t), "u": _described(u), "start": start}
    made = lambda: LTPSystem(F, G, P, Q, omega=omega)  # noqa: E731
    flat = rng.standard_normal((n, n)) - 2.0 * np.eye(n)
    A = one_of(rng, [flat, flat, flat / 10, np.zeros((n, n))], [flat * 1e300, flat * np.nan, "A"])
    told["A"] = A

    def exponents(said):
        _finite(made().floquet_exponents())

    def monodromy(said):
        made().monodromy(start)

    def decomposition(said):
        _finite(made().harmonic_decomposition(N).A)

    def simulation(said):
        made().simulate(u, t, x0)

    def transfer(said):
        made().harmonic_transfer_function(frequencies, N, max_internal_harmonics=16)

    def participation(said):
        made().modal_participation(N)

    def norms(said):
        B, C = np.ones((n, m)), np.ones((p, n))
        hinf_norm(A, B, C, np.zeros((p, m)), dt)

    def trim(said):
        system = PeriodicSystem(
            _hardening,
            period=one_of(rng, [2 * np.pi, 2 * np.pi / OMEGA]),
            state_names=[f"x{k}" for k in range(n)],
            input_names=[f"u{k}" for k in range(m)],
        )
        found = system.trim(one_of(rng, [1, 3, 5]))
        system.linearize(found).floquet_exponents()
        system.simulate(mild, t, x0)

    def structures(said):
        structure = draw_structure(rng)
        structure.matrices(np.ones(structure.n_parameters)), repr(structure), str(structure)
        structure.fix({one_of(rng, ["a", "b", "A[0,0]"]): one_of(rng, NUMBERS)})

    def harmonic_structures(said):
        structure = draw_harmonic_structure(rng)
        repr(structure), str(structure)
        structure.parameter_names(["y0", "y1"][:n], ["u0"])

    body = pick(rng, [exponents, monodromy, decomposition, simulation, simulation, transfer,
                      participation, norms, trim, structures, harmonic_structures])  # fmt: skip

    def perform(said):
        body(said)
        return "done"

    also = {norms: (ArithmeticError,), trim: (RuntimeError,)}.get(body, ())
    return Call(body.__name__, perform, (), told, also)
