"""Progress bars: seen where somebody looks on, nowhere else, and of no effect on results."""

import io
import pickle
import sys
import types
import warnings
from contextlib import redirect_stderr

import numpy as np
import pandas as pd
import pytest
from conftest import KEPT
from joblib import parallel_config
from scipy import signal
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator

from sklearn_hd import (
    HarmonicAnalyzer,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
)
from sklearn_hd._progress import KERNEL, progress
from sklearn_hd.algorithms.reporting import stage, within
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.plotting import StabilizationDisplay

A = np.array([[-0.3, 2.0, 0.1], [-2.0, -0.2, 0.4], [0.3, 0.2, -6.0]])
B = np.array([[1.0, 0.2], [0.4, -1.0], [3.0, 2.0]])
C = np.array([[1.0, 0.0, 0.4], [0.2, 1.0, -0.3]])
STRUCTURE = MatrixStructure([["-a", "w"], ["-w", "-b"]], [[1.0, "g"], ["h", -1.0]])
SEARCHES = {
    "hinf": {},
    "h2": {"criterion": "h2"},
    "least squares": {"criterion": "least_squares"},
    "likelihood": {"criterion": "output_error", "max_iter": 10},
    "noisy inputs": {"criterion": "output_error", "input_noise": 0.1, "max_iter": 2},
}


class Screen(io.StringIO):
    """A terminal, as far as it says."""

    def isatty(self):
        return True

    def frames(self):
        return self.getvalue().replace("\n", "\r").split("\r")

    def left(self):
        """Lines that stand there at the end: after a return a line is written over."""
        shown = []
        for line in self.getvalue().split("\n"):
            text = ""
            for part in line.split("\r"):
                text = part + text[len(part) :]
            shown.append(text.rstrip())
        return [line for line in shown if line]


@pytest.fixture
def screen():
    return Screen()


@pytest.fixture(scope="module")
def record():
    random = np.random.default_rng(0)
    time = 0.05 * np.arange(400)
    u = pd.DataFrame(random.standard_normal((400, 2)), time, ["left", "right"])
    discrete = signal.cont2discrete((A, B, C, np.zeros((2, 2))), 0.05)[:4]
    _, y, _ = signal.dlsim((*discrete, 0.05), u.to_numpy())
    return u, pd.DataFrame(y, time, ["x", "v"])


@pytest.fixture(scope="module")
def identified(record):
    return FrozenEstimator(MOESPRegressor(order=3, block_rows=8).fit(*record))


@pytest.fixture(scope="module")
def noisy_wing():
    """A short noisy record of the flapping wing behind its analyzer and identified model."""
    data = make_flapping_wing("ltp", n_periods=30, start=8, width=3, snr_db=30, random_state=0)
    X = HarmonicAnalyzer(data.omega).fit(data.inputs, data.outputs).transform(data.inputs)
    return MOESPRegressor(order=6).fit(X, data.outputs).transform(X), data.outputs


def match(identified, record, **options):
    return StructuredMatcher(identified, structure=STRUCTURE, **options).fit(*record)


def learned(estimator):
    """All that a fit leaves but the estimator inside, as bytes."""
    kept = {k: v for k, v in vars(estimator).items() if k not in ("verbose", "estimator_")}
    return {name: pickle.dumps(value) for name, value in kept.items() if name.strip("_") != ""}


# ---- where a bar is seen ----------------------------------------------------------------------


def steps(verbose, stderr):
    with redirect_stderr(stderr), progress(verbose) as report:
        told = stage(report, "starts", 4)
        for k in range(3):
            if told is not None:
                told(k + 1, f"error {1 / (k + 1):.2f}")
    return report


def test_a_terminal_shows_a_bar_that_ends_full(screen):
    steps(1, screen)
    assert screen.frames()[1].startswith("starts:   0%")
    (line,) = screen.left()
    assert line.startswith("starts: 100%")
    assert "3/3" in line  # of four: a search that ends early is done
    assert "error 0.33" in line


@pytest.mark.parametrize("verbose", [0, False])
def test_silent_unless_asked(screen, verbose):
    assert steps(verbose, screen) is None
    assert screen.getvalue() == ""


def test_nothing_goes_into_a_file(tmp_path, capfd):
    with (tmp_path / "log").open("w") as log:
        assert steps(1, log) is None
    assert (tmp_path / "log").read_text() == ""
    assert capfd.readouterr() == ("", "")


def test_a_process_without_a_console_has_no_bar():
    assert steps(1, None) is None


def test_a_notebook_shows_a_bar_though_its_stderr_is_no_terminal(monkeypatch):
    monkeypatch.setitem(sys.modules, KERNEL, types.ModuleType(KERNEL))
    cell = io.StringIO()
    steps(True, cell)
    assert "starts: 100%" in cell.getvalue()


def test_one_line_for_all_stages(screen):
    with redirect_stderr(screen), progress(1) as report:
        stage(report, "starts", 4)(4, "")
        stage(report, "of unknown length")(7, "still at it")
        stage(within(report, "F 2"), "steps", 9)(5, "")
    assert any(frame.startswith("of unknown length: 0it") for frame in screen.frames())
    assert [line.split(":")[0] for line in screen.left()] == ["steps (F 2)"]


def test_warnings_have_lines_of_their_own(screen, monkeypatch):
    def show(message, *rest, **options):  # pytest keeps them from stderr otherwise
        print("warning:", message, file=sys.stderr)

    monkeypatch.setattr(warnings, "showwarning", show)
    with redirect_stderr(screen), warnings.catch_warnings(), progress(1) as report:
        warnings.simplefilter("always")
        warnings.warn("before any bar", UserWarning, stacklevel=1)
        told = stage(report, "starts", 4)
        told(1, "")
        warnings.warn("something is odd", UserWarning, stacklevel=1)
        told(4, "")
    assert warnings.showwarning is show
    assert screen.left()[:-1] == ["warning: before any bar", "warning: something is odd"]
    assert screen.left()[-1].startswith("starts: 100%")


def test_warnings_are_recorded_as_ever(screen):
    show = warnings.showwarning
    with redirect_stderr(screen), pytest.warns(UserWarning, match="odd"):
        warned()
    assert warnings.showwarning is show


def warned():
    with progress(1) as report:
        stage(report, "starts", 4)
        warnings.warn("something is odd", UserWarning, stacklevel=2)


def interrupted(error, *reports):
    with progress(1) as report:
        for told in reports:
            report(*told)
        raise error


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_nothing_is_left_after_an_exception(screen, error):
    with redirect_stderr(screen), pytest.raises(error):
        interrupted(error, ("starts", 4, 0, ""), ("starts", 4, 1, ""), ("steps", None, 1, ""))
    assert "starts" in screen.getvalue()
    assert screen.left() == []


def test_nothing_is_shown_before_the_first_report(screen):
    with redirect_stderr(screen), pytest.raises(ValueError, match="at once"):
        interrupted(ValueError("at once"))
    with redirect_stderr(screen), progress(1):
        pass
    assert screen.getvalue() == ""


def test_nobody_to_tell():
    assert stage(None, "starts") is None
    assert within(None, "F 2") is None


# ---- in the estimators ------------------------------------------------------------------------


@pytest.mark.parametrize("estimator", [StructuredMatcher, SpuriousModeReducer])
@pytest.mark.parametrize("verbose", [-1, 0.5, "yes", None])
def test_verbose_is_a_count(estimator, verbose, record):
    step = estimator(MOESPRegressor(order=3, block_rows=8), verbose=verbose)
    with pytest.raises(
        ValueError, match=r"verbose must be .* at least 0, got .*; 0 is silent, 1 s"
    ):
        step.fit(*record)


@pytest.mark.parametrize("options", SEARCHES.values(), ids=SEARCHES)
@pytest.mark.filterwarnings("ignore:the model has 3 states, the structure 2")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_a_match_is_the_same_with_a_bar(identified, record, options, screen):
    with redirect_stderr(screen):
        quiet = match(identified, record, **options)
        assert screen.getvalue() == ""
        told = match(identified, record, **options, verbose=1)
    (line,) = screen.left()
    assert "100%" in line
    assert learned(told) == learned(quiet)
    assert clone(told).get_params()["verbose"] == 1
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(told)).theta_, quiet.theta_)


@pytest.mark.filterwarnings("ignore:the model has 3 states, the structure 2")
def test_starts_at_once_are_counted_as_they_end(identified, record, screen):
    quiet = match(identified, record)
    with redirect_stderr(screen), parallel_config(backend="threading", n_jobs=2):
        told = match(identified, record, verbose=1)
    assert any(frame.startswith("minimax, smooth descents") for frame in screen.frames())
    np.testing.assert_array_equal(told.theta_, quiet.theta_)


def test_orders_tried_period_by_period_are_counted(screen):
    data = make_flapping_wing("nltp", n_periods=40, start=12)
    analyzer = HarmonicAnalyzer(
        data.omega, output_harmonics=KEPT, reading="period", trim_span=data.trim_span
    )
    X = analyzer.fit(data.inputs, data.outputs).transform(data.inputs)
    quiet = MOESPRegressor().fit(X, data.outputs)
    with redirect_stderr(screen):
        told = MOESPRegressor(verbose=1).fit(X, data.outputs)
    assert any(frame.startswith("orders tried") for frame in screen.frames())
    assert told.order_ == quiet.order_


def test_chunks_of_a_quiet_model_write_nothing(record, screen):
    u, y = record
    with redirect_stderr(screen):
        MOESPRegressor(3, block_rows=6).partial_fit(u, y)
    assert screen.getvalue() == ""


def test_no_bar_is_left_of_a_match_that_fails(identified, record, screen):
    growing = MatrixStructure(
        [["p", "w"], ["-w", "p"]], [[1.0, "g"], ["h", -1.0]], bounds={"p": (0.5, None)}
    )
    matcher = StructuredMatcher(identified, structure=growing, n_starts=1, max_iter=5, verbose=1)
    with (
        redirect_stderr(screen),
        pytest.raises(UnstableModelError, match="no stable model of this structure"),
    ):
        matcher.fit(*record)
    assert "least squares, starts" in screen.getvalue()
    assert screen.left() == []


@pytest.mark.filterwarnings("ignore::sklearn_hd.exceptions.IdentifiabilityWarning")
def test_a_reduction_is_the_same_with_a_bar(noisy_wing, screen):
    with redirect_stderr(screen):
        quiet = SpuriousModeReducer().fit(*noisy_wing)
        assert screen.getvalue() == ""
        told = SpuriousModeReducer(verbose=1).fit(*noisy_wing)
    assert "likelihood of modes, steps" in screen.getvalue()
    assert learned(told) == learned(quiet)


def test_a_sweep_over_orders_shows_a_bar(record, screen):
    options = {"orders": [1, 2, 3], "block_rows": 8}
    with redirect_stderr(screen):
        quiet = StabilizationDisplay.from_data(*record, **options)
        assert screen.getvalue() == ""
        told = StabilizationDisplay.from_data(*record, **options, verbose=1)
    (line,) = screen.left()
    assert line.startswith("orders: 100%")
    assert "3/3" in line
    pd.testing.assert_frame_equal(told.modes, quiet.modes)


# ---- what algorithms tell ---------------------------------------------------------------------


@pytest.mark.parametrize("options", SEARCHES.values(), ids=SEARCHES)
@pytest.mark.filterwarnings("ignore:the model has 3 states, the structure 2")
@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_every_stage_begins_at_zero_and_counts_up(identified, record, options, monkeypatch):
    heard = []

    class Listener:
        def __enter__(self):
            return lambda *told: heard.append(told)

        def __exit__(self, *error):
            return None

    monkeypatch.setattr("sklearn_hd.matching.progress", lambda verbose: Listener())
    match(identified, record, **options)
    stages = [name for name, *_ in heard]
    assert stages[0] == "least squares, starts"
    for name in set(stages):
        own = [told for told in heard if told[0] == name]
        done = [told[2] for told in own]
        assert done[0] == 0
        assert done == sorted(done)
        assert len({told[1] for told in own}) == 1
        assert done[-1] <= own[0][1]
