"""The report of a fitted pipeline: laws of the page, and what it refuses."""

import re
import warnings
from html.parser import HTMLParser
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from sklearn.exceptions import NotFittedError
from sklearn.pipeline import Pipeline

from sklearn_hd import (
    HarmonicAnalyzer,
    HarmonicStructure,
    MatrixStructure,
    MOESPRegressor,
    SpuriousModeReducer,
    StructuredMatcher,
    report,
)
from sklearn_hd._report.page import digits, with_reach
from sklearn_hd.datasets import make_flapping_wing
from sklearn_hd.exceptions import IdentifiabilityWarning, TimeBaseWarning

SECTIONS = ["data", "harmonics", "order", "modes", "model", "residuals", "validation"]
SECTIONS += ["warnings", "settings", "versions"]
WINGS = {"n_periods": 40, "start": 8, "width": 6, "amplitude": 0.01, "snr": 20}


class Page(HTMLParser):
    """What a page links to, its tags, and its text by section."""

    def __init__(self, path):
        super().__init__()
        self.links, self.tags, self.text, self.open = [], [], {}, "head"
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.tags.append(tag)
        self.links += [given[name] for name in ("src", "href") if name in given]
        if tag == "section":
            self.open = given["id"]

    def handle_data(self, data):
        self.text[self.open] = self.text.get(self.open, "") + " " + data


def lag(n=400, noise=0.1, names=("u", "y"), seed=0):
    """Records of y[k+1] = 0.8 y[k] + u[k], with noise that moves the state."""
    u, e = np.random.default_rng(seed).standard_normal((2, n))
    y = np.zeros(n)
    for k in range(1, n):
        y[k] = 0.8 * y[k - 1] + u[k - 1] + noise * e[k]
    index = pd.Index(0.1 * np.arange(n), name="time")
    return pd.DataFrame({names[0]: u}, index), pd.DataFrame({names[1]: y}, index)


def plain(**parameters):
    return MOESPRegressor(order=1, block_rows=5, disturbance_model=True, **parameters)


@pytest.fixture(scope="module")
def wing():
    return make_flapping_wing("nltp", random_state=0, **WINGS)


@pytest.fixture(scope="module")
def by_period(wing):
    pipe = Pipeline(
        [
            ("harmonics", HarmonicAnalyzer(wing.omega)),
            ("identify", MOESPRegressor()),
            ("reduce", SpuriousModeReducer()),
            ("match", StructuredMatcher(structure=HarmonicStructure(), criterion="output_error")),
        ]
    )
    return pipe.fit(wing.inputs, wing.outputs)


@pytest.fixture(scope="module")
def by_sample(wing):
    analyzer = HarmonicAnalyzer(wing.omega, reading="sample", output_harmonics=1)
    steps = [("harmonics", analyzer), ("identify", MOESPRegressor(order=2))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", IdentifiabilityWarning)  # the wrong order is meant
        return Pipeline(steps).fit(wing.inputs, wing.outputs)


def words(text):
    """Text with one space between words."""
    return " ".join(text.split())


def check_whole(path):
    """Laws of every page; returns it."""
    page = Page(path)
    assert isinstance(path, Path)
    assert "script" not in page.tags
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in page.links)
    assert [name for name in page.text if name != "head"] == SECTIONS
    assert all(page.text[name].strip() for name in SECTIONS)
    for anchor in (link[1:] for link in page.links if link.startswith("#")):
        assert anchor in SECTIONS
    return page


@pytest.mark.slow
@pytest.mark.parametrize("n_steps", [pytest.param(2, marks=pytest.mark.slow), 4])
def test_pages_of_whole_periods_stand_alone_and_show_every_mode(wing, by_period, n_steps, tmp_path):
    open_before = plt.get_fignums()
    path = report(by_period[:n_steps], wing.inputs, wing.outputs, tmp_path / "wing.html")
    page = check_whole(path)
    assert plt.get_fignums() == open_before
    model = by_period[n_steps - 1]
    for exponent in by_period["identify"].model_.exponents():
        assert digits(exponent) in page.text["modes"]
    if n_steps == 4:
        for row in model.eigenvalues_.itertuples():
            assert with_reach(row.eigenvalue.real, 1.959964 * row.std_real) in page.text["model"]
    assert "was used to fit" in page.text["head"]
    assert digits(by_period[:n_steps].score(wing.inputs, wing.outputs)) in page.text["head"]


@pytest.mark.slow
def test_page_of_samples(wing, by_sample, tmp_path):
    page = check_whole(report(by_sample, wing.inputs, wing.outputs, tmp_path / "samples.html"))
    for exponent in by_sample["identify"].model_.exponents():
        assert digits(exponent.real, 3)[:4] in page.text["modes"]
    assert "each row as a sample with its azimuth" in page.text["harmonics"]
    assert "Loads" in page.text["model"]
    assert "This model may be wrong" in page.text["head"]


@pytest.mark.slow
def test_page_of_a_sliding_window_names_window_and_every_verdict(tmp_path):
    wing = make_flapping_wing("lti")
    steps = [
        ("harmonics", HarmonicAnalyzer(wing.omega, reading="sliding")),
        ("identify", MOESPRegressor()),
        ("reduce", SpuriousModeReducer()),
    ]
    pipe = Pipeline(steps).fit(wing.inputs, wing.outputs)
    page = check_whole(report(pipe, wing.inputs, wing.outputs, tmp_path / "window.html"))
    assert "boxcar" in page.text["harmonics"]
    for mode in pipe["reduce"].modes_.itertuples():
        assert digits(mode.eigenvalue) in page.text["modes"]
        assert mode.verdict in page.text["modes"]


@pytest.mark.slow
def test_plain_arrays_series_and_validation(tmp_path):
    u, y = lag()
    new = lag(seed=1)
    path = report(
        plain().fit(u.to_numpy(), y["y"].to_numpy()),
        u.to_numpy(),
        y["y"].to_numpy(),
        str(tmp_path / "plain.html"),
        validation=(new[0].to_numpy(), new[1]["y"].to_numpy()),
    )
    page = check_whole(path)
    assert "which was not used to fit" in page.text["head"]
    assert "No check found a fault" in page.text["head"]


@pytest.mark.slow
def test_several_records_and_no_inputs(tmp_path):
    u, y = (pd.concat({"a": a, "b": b}) for a, b in zip(lag(), lag(seed=1), strict=True))
    page = check_whole(report(plain().fit(u, y), u, y, tmp_path / "records.html"))
    assert re.search(r"records\s+2", page.text["data"])
    assert "record a" in page.text["data"]
    page = check_whole(report(plain().fit(None, y), None, y, tmp_path / "alone.html"))
    assert "from outputs alone" in page.text["head"]


@pytest.mark.slow
def test_names_are_escaped(tmp_path):
    u, y = lag(names=("<b>", "a&<script>"))
    path = report(plain().fit(u, y), u, y, tmp_path / "names.html", units={"<b>": "<i>"})
    page, text = check_whole(path), path.read_text(encoding="utf-8")
    assert "&lt;b&gt;" in text
    assert "&lt;script&gt;" in text
    assert "<i>" in page.text["data"]
    assert not {"i", "script"} & set(page.tags)
    assert "a&<script>" in page.text["data"]


@pytest.mark.slow
def test_a_matrix_structure_shows_its_parameters(tmp_path):
    u, y = lag()
    structure = MatrixStructure([["-rate"]], [["gain"]])
    matcher = StructuredMatcher(plain(), structure=structure, criterion="prediction_error")
    page = check_whole(report(matcher.fit(u, y), u, y, tmp_path / "matrix.html"))
    interval = matcher.confidence_interval()
    half = 0.5 * (interval["upper"] - interval["lower"])
    for name, value in matcher.theta_.items():
        assert f"{name} {with_reach(value, half[name])}" in words(page.text["model"])


@pytest.mark.slow
def test_a_wrong_model_says_so_at_the_top(tmp_path):
    rng = np.random.default_rng(0)
    u, e, y = rng.standard_normal((3, 2000))
    y[:2] = 0.0
    for k in range(2, 2000):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + u[k - 1] + 0.1 * e[k]
    model = plain().fit(u[:, None], y)
    page = check_whole(report(model, u[:, None], y, tmp_path / "wrong.html"))
    tests = model.residual_tests(u[:, None], y)
    failed = tests[~tests["passed"]]
    assert "This model may be wrong" in page.text["head"]
    assert f"{len(failed)} of {len(tests)} tests fail" in page.text["head"]
    assert digits(100.0 * failed["share"].max(), 2) in page.text["head"]


@pytest.mark.slow
def test_settings_tell_what_was_left(tmp_path):
    u, y = lag()
    page = check_whole(report(plain(scale=False).fit(u, y), u, y, tmp_path / "set.html"))
    for name, value in plain(scale=False).get_params().items():
        how = "set" if name in ("order", "block_rows", "disturbance_model", "scale") else "default"
        assert f" {name} {value!r} {how}" in words(page.text["settings"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:X does not have valid feature names")
def test_arrays_have_the_clock_of_the_fit(tmp_path):
    data = make_flapping_wing("ltp", n_periods=30, start=5, width=3, snr=20, random_state=0)
    steps = [("harmonics", HarmonicAnalyzer(data.omega)), ("identify", MOESPRegressor())]
    pipe = Pipeline(steps).fit(data.inputs, data.outputs)
    arrays = data.inputs.to_numpy(), data.outputs.to_numpy()
    with pytest.warns(TimeBaseWarning, match="as at fit"):
        check_whole(report(pipe, *arrays, tmp_path / "arrays.html"))


def test_bad_input_is_named(tmp_path):
    u, y = lag()
    model, path = plain().fit(u, y), tmp_path / "page.html"
    with pytest.raises(NotFittedError):
        report(plain(), u, y, path)
    with pytest.raises(ValueError, match=r"no folder.*make it, or give a path"):
        report(model, u, y, tmp_path / "no folder" / "page.html")
    with pytest.raises(ValueError, match=r"is a folder; give the name of a file"):
        report(model, u, y, tmp_path)
    with pytest.raises(TypeError, match=r"path=3 is no path"):
        report(model, u, y, 3)
    with pytest.raises(ValueError, match=r"feature names should match"):
        report(model, u.rename(columns={"u": "v"}), y, path)
    with pytest.raises(ValueError, match=r"validation=DataFrame.*give a pair"):
        report(model, u, y, path, validation=u)
    with pytest.raises(ValueError, match=r"feature names should match"):
        report(model, u, y, path, validation=(u.rename(columns={"u": "v"}), y))
    with pytest.raises(ValueError, match=r"units="):
        report(model, u, y, path, units="m/s")
    with pytest.raises(ValueError, match=r"units= names \['w0'\], but the signals are"):
        report(model, u, y, path, units={"w0": "m/s"})
    assert not path.exists()


@pytest.mark.parametrize(
    ("value", "reach", "words"),
    [
        (-12.5412, 0.923, "−12.54 ± 0.92"),
        (237353.0, 95911.0, "237000 ± 96000"),
        (1.13e-4, 2.1e-5, "0.000113 ± 0.000021"),
        (6.4e-5, 1.6e-5, "(6.4 ± 1.6)e−5"),
        (0.0, 0.5, "0.00 ± 0.50"),
        (2.0, np.nan, "2"),
        (2.0, np.inf, "2 ± inf"),
        (np.nan, np.nan, "–"),
    ],
)
def test_a_value_is_rounded_to_two_digits_of_its_interval(value, reach, words):
    assert with_reach(value, reach) == words


def test_a_report_is_a_page_of_html(tmp_path):
    with pytest.raises(
        ValueError, match=r"does not end in \.html, and the report is a page of HTML"
    ):
        report(None, None, None, tmp_path / "wing.pdf")
