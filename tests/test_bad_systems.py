"""Wrong arguments of systems, the catalog and frequency responses end in errors that say so."""

import inspect

import numpy as np
import pandas as pd
import pytest

from sklearn_hd import MatrixStructure, MOESPRegressor, StructuredMatcher
from sklearn_hd.algorithms.lti.hinf import hinf_norm
from sklearn_hd.algorithms.signals.fundamental import estimate_omega
from sklearn_hd.systems import (
    FourierMatrix,
    LTPSystem,
    PeriodicSystem,
    coupled_oscillators,
    duffing,
    estimate_harmonic_transfer_function,
    flapping_blade,
    flapping_wing,
    mathieu,
)

# ---- the catalog ------------------------------------------------------------------------------

NO_NUMBERS = ["x", None, np.nan, np.inf, 1j, [1.0, 2.0], True, 10**400]
PARAMETERS = [
    (entry, name)
    for entry in (coupled_oscillators, duffing, flapping_blade, flapping_wing, mathieu)
    for name in inspect.signature(entry).parameters
    if name not in ("frequencies", "damping_ratios", "coupling")  # arrays
]


@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: repr(value)[:8])
@pytest.mark.parametrize(("entry", "name"), PARAMETERS)
def test_parameters_are_finite_real_numbers(entry, name, value):
    message = rf"^{name} must be a ((finite|nonnegative|positive) )?number.*, got .*; "
    with pytest.raises(ValueError, match=message):
        entry(**{name: value})


SIGNS = {
    flapping_blade: {"nonnegative": ["gamma", "mu", "nu"], "positive": ["omega"]},
    duffing: {"nonnegative": ["damping"], "positive": ["omega"]},
    coupled_oscillators: {"positive": ["omega"]},
    flapping_wing: {
        "nonnegative": ["k_d1", "k_d2", "k_d3"],
        "positive": ["k_L", "inverse_inertia", "omega", "gravity"],
    },
}


@pytest.mark.parametrize("entry", SIGNS, ids=lambda entry: entry.__name__)
def test_signs_that_parameters_may_have(entry):
    for kind, names in SIGNS[entry].items():
        for name in names:
            with pytest.raises(ValueError, match=f"{name} must be a {kind} number.*, got -1.0; "):
                entry(**{name: -1.0})
            if kind == "positive":
                with pytest.raises(ValueError, match=f"{name} must be a positive .*, got 0"):
                    entry(**{name: 0})
            else:
                assert entry(**{name: 0}).n_states == 2


def test_negative_damping_of_a_linear_oscillator_is_growth():
    sums = [mathieu(damping=d).floquet_exponents().sum().real for d in (0.3, -0.3)]
    np.testing.assert_allclose(sums, [-0.3, 0.3], atol=1e-12)


def test_a_force_of_opposite_sign_is_half_a_period_later():
    """The trim starts near the oscillation of that force, not of its opposite."""
    up, down = (duffing(amplitude=sign * 1.0).trim(5).coefficients for sign in (1, -1))
    np.testing.assert_allclose(down, -up, atol=1e-10)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frequencies": (1.0, -2.0)}, r"frequencies\[1\] must be a positive number in rad/s"),
        (
            {"frequencies": "ab"},
            r"frequencies='ab' is not an array of real numbers; give two natural",
        ),
        ({"damping_ratios": (0.1, np.nan)}, r"damping_ratios holds NaN or infinity; give two"),
        ({"damping_ratios": None}, r"damping_ratios=None is not an array of real numbers"),
        (
            {"coupling": [[1.0], [1.0, 2.0]]},
            r"coupling=\[\[1.0\], .* is not an array of real numbers",
        ),
        (
            {"coupling": np.eye(2) * 1j},
            r"coupling=array\(.* is not an array of real numbers; give stiff",
        ),
    ],
)
def test_coupled_oscillators_take_numbers(given, message):
    with pytest.raises(ValueError, match=message):
        coupled_oscillators(**given)


# ---- frequencies ------------------------------------------------------------------------------

FREQUENCIES = {
    "text": (
        "a",
        r"frequencies='a' is not an array of real numbers; give finite real numbers in rad/s",
    ),
    "texts of numbers": (["1.0", "2.0"], r"frequencies=\['1.0', '2.0'\] is not an array of real"),
    "none": (None, r"frequencies=None is not an array of real numbers"),
    "matrix": ([[1, 2]], r"frequencies has shape \(1, 2\); give .* in one dimension"),
    "nan": ([np.nan], r"frequencies holds NaN or infinity; give finite real numbers in rad/s"),
    "complex": ([1j], r"frequencies=\[1j\] is not an array of real numbers"),
    "ragged": ([[1], [1, 2]], r"frequencies=\[\[1\], \[1, 2\]\] is not an array of real numbers"),
    "too large": ([10**400], r"frequencies=.* is not an array of real numbers"),
}


@pytest.fixture(scope="module")
def lag():
    """A first-order lag matched by maximum likelihood."""
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((200, 1)), np.zeros((200, 1))
    for k in range(199):
        y[k + 1] = 0.8 * y[k] + u[k]
    y += 0.1 * rng.standard_normal(y.shape)
    structure = MatrixStructure([["-a"]], [["b"]])
    estimator = MOESPRegressor(order=1, block_rows=5)
    return StructuredMatcher(estimator, structure=structure, criterion="output_error").fit(u, y)


@pytest.mark.parametrize("case", FREQUENCIES)
def test_frequencies(lag, case):
    given, message = FREQUENCIES[case]
    for response in (lag.frequency_response, lambda f: mathieu().harmonic_transfer_function(f, 1)):
        with pytest.raises(ValueError, match=message):
            response(given)


def test_one_frequency_is_an_array_of_one(lag):
    for found, expected in zip(
        lag.frequency_response(2), lag.frequency_response([2.0]), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("level", ["95%", None, [0.9], 0.0, 1, 95, np.nan, True])
def test_confidence_is_a_probability(lag, level):
    with pytest.raises(ValueError, match=r"level must be a number between 0 and 1, got .*; it"):
        lag.confidence_interval(level)


# ---- linear systems ---------------------------------------------------------------------------

TIMES = np.arange(10) / 10
LINEAR = {
    "coefficients": (lambda s: s.fourier_coefficients(-1), "n_harmonics must be a whole number"),
    "text of coefficients": (lambda s: s.fourier_coefficients("2"), "whole number .* got '2'"),
    "start": (lambda s: s.monodromy("x"), "start must be a finite number, got 'x'; it is the azi"),
    "start nowhere": (lambda s: s.monodromy(np.nan), "start must be a finite number, got nan"),
    "harmonics of inputs": (
        lambda s: s.harmonic_decomposition(1, 0.5),
        "n_input_harmonics must be a whole number of at least 0, got 0.5; 0 keeps the mean alone",
    ),
    "tolerance": (
        lambda s: s.harmonic_transfer_function([1.0], 1, tolerance=0),
        "tolerance must be a positive number, got 0; 1e-8 is usual",
    ),
    "participation": (lambda s: s.modal_participation(None), "n_harmonics must be .* got None"),
    "shares": (lambda s: s.modal_participation([1]), r"n_harmonics must be .* got \[1\]"),
    "inputs": (
        lambda s: s.simulate("a", TIMES),
        r"u='a' is not an array of real numbers; give 10 values of each of \['u'\], finite",
    ),
    "complex inputs": (
        lambda s: s.simulate(1j * TIMES, TIMES),
        r"u=array\(.* is not an array of real numbers",
    ),
    "inputs not finite": (lambda s: s.simulate(TIMES / 0, TIMES), "u holds NaN or infinity; give"),
    "times": (
        lambda s: s.simulate(TIMES, None),
        "t=None is not an array of real numbers; give two",
    ),
    "endless": (
        lambda s: s.simulate(TIMES[:3], [0.0, 1.0, np.inf]),
        "t holds NaN or infinity; give two or more finite, increasing times",
    ),
    "state": (
        lambda s: s.simulate(TIMES, TIMES, [np.nan, 0.0]),
        r"x0 holds NaN or infinity; give one finite value for each of the states \['y', 'y_dot'\]",
    ),
    "flag": (
        lambda s: s.simulate(TIMES, TIMES, return_states="no"),
        "return_states must be True or False, got 'no'",
    ),
}


@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning", "ignore:divide:RuntimeWarning")
@pytest.mark.parametrize("case", LINEAR)
def test_methods_of_linear_systems(case):
    call, message = LINEAR[case]
    with pytest.raises(ValueError, match=message):
        call(mathieu())


MATRICES = {
    "text": (
        {"F": "ab"},
        r"F='ab' is not an array of real numbers; give a matrix \(rows, columns\), F",
    ),
    "nan": ({"F": [[np.nan]]}, r"F holds NaN or infinity; give a matrix"),
    "complex": ({"G": [[1j]]}, r"G=\[\[1j\]\] is not an array of real numbers"),
    "omega": ({"omega": "fast"}, r"omega must be a positive number in rad/s, got 'fast'; it is 2π"),
    "names": ({"state_names": 3}, r"state_names=3 must name each signal in text, as \['w', 'phi_"),
    "numbers": ({"input_names": [1]}, r"input_names=\[1\] must name each signal in text"),
}


@pytest.mark.parametrize("case", MATRICES)
def test_linear_systems(case):
    given, message = MATRICES[case]
    with pytest.raises(ValueError, match=message):
        LTPSystem(**{"F": [[-1.0]], "G": [[1.0]], "omega": 1.0} | given)
    with pytest.raises(ValueError, match="coefficients='x' is not an array of real numbers; give"):
        FourierMatrix("x")


# ---- harmonic transfer functions --------------------------------------------------------------


@pytest.mark.parametrize("harmonic", ["1", None, 0.5, True])
def test_harmonics_of_a_transfer_function_are_whole(harmonic):
    response = mathieu().harmonic_transfer_function([1.0], 1)
    with pytest.raises(ValueError, match=rf"harmonic {harmonic!r} is not among −1 … 1; give a wh"):
        response.harmonic(harmonic)


ESTIMATES = {
    "overlap": ({"overlap": "half"}, r"overlap must be a number from 0 to below 1, got 'half'; it"),
    "window": (
        {"window": "hanning!"},
        r"window='hanning!' is not a window of scipy.signal.get_window",
    ),
    "window of nan": (
        {"window": np.nan},
        r"window=nan is not a window of scipy.signal.get_window",
    ),
    "origin": ({"time_origin": "noon-ish"}, r"time_origin='noon-ish' is not understood; give the"),
}


@pytest.fixture
def noise():
    values = np.random.default_rng(0).standard_normal(1000)
    return pd.Series(values, np.arange(1000.0), name="u")


@pytest.mark.parametrize("case", ESTIMATES)
def test_estimates(noise, case):
    given, message = ESTIMATES[case]
    usual = {"u": noise, "y": noise, "omega": 0.4, "n_harmonics": 1}
    with pytest.raises(ValueError, match=message):
        estimate_harmonic_transfer_function(**usual | given)


def test_records_of_estimates(noise):
    with pytest.raises(TypeError, match="u is None, which is not a table of signals; give a DataF"):
        estimate_harmonic_transfer_function(None, noise, 0.4, 1)
    with pytest.raises(ValueError, match="y holds values that are not numbers"):
        estimate_harmonic_transfer_function(noise, noise.map(lambda _: "low"), 0.4, 1)
    estimate = estimate_harmonic_transfer_function(noise, noise, 0.4, 1)
    with pytest.raises(ValueError, match="model='x' is not a HarmonicTransferFunction; give the"):
        estimate.misfit("x")


# ---- nonlinear systems ------------------------------------------------------------------------


def decay(x, u, t):
    return -x


PERIODIC = {
    "function": ({"f": "x"}, r"f='x' must be a function of \(x, u, t\)$"),
    "order of scipy": (
        {"f": lambda t, x, u: x},
        r"f takes \(t, x, u\), and is called with \(x, u, t\): give f=lambda x, u, t",
    ),
    "outputs": ({"g": 3}, r"g=3 must be a function of \(x, u, t\), or None"),
    "one output": ({"g": lambda x, u, t: x[0]}, r"g returned an array of shape \(\) for one point"),
    "jacobian": ({"jacobian": 0}, r"jacobian=0 must be a function of \(x, u, t\), or None"),
    "period": ({"period": None}, r"period must be a positive number in seconds, got None; f and g"),
    "names": ({"input_names": 2}, r"input_names=2 must name each signal in text"),
    "guess": (
        {"trim_guess": "rest"},
        r"the trim guess is 'rest'; give a Trim, or a pair of arrays",
    ),
    "guess of nan": (
        {"trim_guess": ([[np.nan]], [0.0])},
        r"the trim guess holds NaN or infinity; give a Trim, or a pair",
    ),
    "even guess": (
        {"trim_guess": ([[0.0], [0.0]], [0.0])},
        r"has shapes \(2, 1\) and \(1,\); give .* coefficients \(2 K \+ 1, 1\) and inputs \(1,\)",
    ),
    "targets": ({"trim_targets": "a"}, r"trim_targets='a' must be a dict of numbers by name; the"),
    "target": ({"trim_targets": {"b": 0}}, r"trim_targets names \['b'\]; the states are \['a'\]"),
}


@pytest.mark.parametrize("case", PERIODIC)
def test_periodic_systems(case):
    given, message = PERIODIC[case]
    usual = {"f": decay, "period": 1.0, "state_names": ["a"], "input_names": ["b"]}
    with pytest.raises(ValueError, match=message):
        PeriodicSystem(**usual | given)


TRIM = {
    "targets": ({"targets": [0.0]}, r"targets=\[0.0\] must be a dict of numbers by name; the sta"),
    "target": ({"targets": {"x": "low"}}, r"targets\['x'\] must be a finite number, got 'low'"),
    "inputs": ({"inputs": {"u": np.nan}}, r"inputs\['u'\] must be a finite number, got nan"),
    "input list": ({"inputs": [1.0]}, r"inputs=\[1.0\] must be a dict of numbers by name; the inp"),
    "guess": ({"guess": "x"}, r"the trim guess is 'x'; give a Trim, or a pair of arrays"),
    "points": ({"n_points": "many"}, r"n_points must be a whole number of at least 1, got 'many'"),
}


@pytest.mark.parametrize("case", TRIM)
def test_trim(case):
    given, message = TRIM[case]
    with pytest.raises(ValueError, match=message):
        duffing().trim(3, **given)


def test_trims_of_other_systems():
    system, trim = duffing(), duffing().trim(3)
    with pytest.raises(ValueError, match=r"trim='x' is not a trim; give the result of trim\(\)"):
        system.linearize("x")
    with pytest.raises(ValueError, match="2 states, 1 inputs and omega=2, but the system has 2"):
        system.linearize(duffing(omega=2.0).trim(3))
    with pytest.raises(ValueError, match="psi='x' is not an array of real numbers; give azimuths"):
        trim.states("x")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rtol": 0}, "rtol must be a positive number, got 0; 1e-12 is usual"),
        ({"atol": -1e-9}, "atol must be a nonnegative number, got -1e-09; 1e-13 is usual"),
        ({"u": "a"}, "u='a' is not an array of real numbers"),
        ({"x0": [0.0, np.inf]}, "x0 holds NaN or infinity; give one finite value for each"),
    ],
)
def test_simulations_of_nonlinear_systems(given, message):
    with pytest.raises(ValueError, match=message):
        duffing().simulate(**{"u": TIMES, "t": TIMES} | given)


# ---- found by the fuzz ------------------------------------------------------------------------


@pytest.mark.parametrize("ask", ["simulate", "monodromy", "floquet_exponents"])
def test_matrices_beyond_floating_point_numbers(ask):
    """NumPy warned, and went on with infinities."""
    F = np.array([-1.0, 0.0, 1e200]).reshape(3, 1, 1)
    given = {"u": np.ones((9, 1)), "t": np.arange(9) / 8} if ask == "simulate" else {}
    with pytest.raises(ValueError, match=r"LTPSystem: the computation failed \(overflow"):
        getattr(LTPSystem(F, [[1.0]], omega=50.0), ask)(**given)


def test_transfer_functions_of_records_too_large_or_too_slow():
    u = np.random.default_rng(0).standard_normal((400, 1))
    with pytest.raises(ValueError, match=r"u reaches .* in column 'u0', too large to be squared"):
        estimate_harmonic_transfer_function(1e300 * u, u, 1.0, 0, sample_time=0.1)
    with pytest.raises(ValueError, match=r"harmonic_transfer_function: the computation failed"):
        estimate_harmonic_transfer_function(u, 1e195 * u, 1.0, 0, sample_time=0.1)
    with pytest.raises(ValueError, match=r"harmonic 1 of omega=1 rad/s lies beyond half the sampl"):
        estimate_harmonic_transfer_function(u, u, 1.0, 0, sample_time=1e3)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sample_time", "sample_time must be a positive number, got .*; seconds from row to row"),
        ("omega", "guess must be a positive number, got .*; rad/s"),
        ("span", "span must be a number between 0 and 1, got .*; how far to search"),
    ],
)
@pytest.mark.parametrize("value", [-1.0, np.nan, "x", [1.0]])
def test_numbers_that_estimate_omega_takes(name, message, value):
    given = {"sample_time": 0.1, "omega": 1.0, "span": 0.1} | {name: value}
    with pytest.raises(ValueError, match=message):
        estimate_omega([np.zeros((90, 1))], [np.ones((90, 1))], **given)


def forced(x, u, t):
    return -x + u + np.cos(2.0 * t)


def parametric(x, u, t):
    return np.array([x[1], -(1.0 + 0.4 * np.cos(2.0 * t)) * x[0] - 0.2 * x[1] + u[0]])


@pytest.mark.parametrize("period", [2.0, 1.0 / 2.0, 3.0 * np.pi / 2.0])
def test_a_period_after_which_f_is_another(period):
    """2, 1/2 and 3π/2 s instead of π s, of f or of its derivative; f of no time has any."""
    names = {"state_names": ["a"], "input_names": ["b"]}
    with pytest.raises(ValueError, match=r"a period of .* s later, .*: period is 2π/omega in sec"):
        PeriodicSystem(forced, period=period, **names).trim(3)
    assert PeriodicSystem(decay, period=period, **names).trim(3).residual < 1e-9
    with pytest.raises(ValueError, match=r"is not the same a period of"):  # in other units
        PeriodicSystem(lambda x, u, t: 1e-6 * forced(1e6 * x, u, t), period=period, **names).trim(3)
    names["state_names"] = ["a", "a_dot"]
    with pytest.raises(ValueError, match=r"a period of .* s later, .*: period is 2π/omega in sec"):
        PeriodicSystem(parametric, period=period, **names).trim(3)


@pytest.mark.parametrize("digits", [5, 7, 15])
@pytest.mark.parametrize("held", [0.0, 0.7, 9.81])
def test_rounding_of_forces_or_of_a_period_is_no_other_f(digits, held):
    """In trim, forces sum to rounding alone."""

    def balanced(x, u, t):
        turning = 2.0 + np.cos(2.0 * t)
        return turning * (u - held) - 0.1 * turning * x

    names = {"state_names": ["a"], "input_names": ["b"]}
    for f, most in ((balanced, 1e-9), (forced, 1e-4)):
        system = PeriodicSystem(f, period=np.round(np.pi, digits), **names)
        assert system.trim(3, inputs={"b": held}).residual < most


def test_a_system_of_no_states_has_no_exponents():
    system = LTPSystem(np.zeros((0, 0)), np.zeros((0, 1)), omega=1.0)
    assert system.floquet_exponents().shape == (0,)


def test_norms_of_texts():
    with pytest.raises(
        ValueError, match=r"A='A' is not an array of real numbers; give finite real"
    ):
        hinf_norm("A", [[1.0]], [[1.0]], [[0.0]])
