"""Displays as they look, against reference images.

Without letters: their edges, and the room that they take, change with matplotlib's version
(by 25 to 40 of 255, where a line left out is 2.4 to 10); lines and panels do not (3.9 to 3.11:
less than 1.8, which is a band's edge). What the letters say, and that none cover others, is
tested in test_plotting.py.

``pytest tests/test_plotting_images.py --mpl-generate-path=tests/baseline`` draws them anew:
look at each before it is kept.
"""

from functools import wraps

import matplotlib.pyplot as plt
import numpy as np
import plotting_cases as cases
import pytest

from sklearn_hd.plotting import (
    BodeDisplay,
    HarmonicsDisplay,
    OrderSelectionDisplay,
    ParticipationDisplay,
    PeriodicMatrixDisplay,
    ResponseDisplay,
)

SMALL = {"baseline_dir": "baseline", "savefig_kwargs": {"dpi": 50}, "tolerance": 2}


def image(test):
    """Compare the figure that a test returns, without letters, with its reference."""

    @wraps(test)
    def drawn(*args, **kwargs):
        return without_letters(test(*args, **kwargs))

    return pytest.mark.mpl_image_compare(**SMALL)(drawn)


def without_letters(figure):
    legends = [*figure.legends, *(axis.get_legend() for axis in figure.axes)]
    for artist in [*filter(None, legends), *(text for axis in figure.axes for text in axis.texts)]:
        artist.remove()
    for axis in figure.axes:
        axis.set_title("", loc="left")
        axis.set(xlabel="", ylabel="")
        axis.tick_params(which="both", labelleft=False, labelright=False, labelbottom=False)
        for ticks in (axis.xaxis, axis.yaxis):
            ticks.offsetText.set_visible(False)
    figure.set_size_inches(np.round(figure.get_size_inches()))  # whole pixels
    return figure


@pytest.mark.parametrize("name", cases.DISPLAYS)
@image
@pytest.mark.slow
def test_display(name):
    return cases.DISPLAYS[name][0]().figure_


@image
@pytest.mark.slow
def test_harmonics_of_twelve_outputs():
    return HarmonicsDisplay.from_data(cases.many_signals(12), 2 * np.pi).figure_


@image
@pytest.mark.slow
def test_response_of_twelve_outputs():
    y = cases.many_signals(12)
    options = {"inputs": y[["blade_0"]].set_axis(["u"], axis=1), "validation_span": (5.0, 8.0)}
    return ResponseDisplay.from_data(y, {"a": 0.9 * y, "b": y + 0.05}, **options).figure_


@image
@pytest.mark.slow
def test_bode_of_twelve_outputs():
    hd = cases.large_system(12).harmonic_decomposition(0)
    return BodeDisplay.from_systems(hd, np.geomspace(0.1, 100.0, 60)).figure_


@image
@pytest.mark.slow
def test_participation_of_seven_states():
    return ParticipationDisplay.from_system(cases.large_system(7), 2).figure_


@image
@pytest.mark.slow
def test_matrix_of_six_states():
    return PeriodicMatrixDisplay.from_systems(cases.large_system(6)).figure_


@image
def test_misfit_by_order():
    return OrderSelectionDisplay.from_estimator(cases.search(), misfit=True).figure_


@image
def test_two_displays_side_by_side():
    figure, (left, right) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    cases.eigenvalues(left)
    cases.periodic_matrix(right)
    return figure
