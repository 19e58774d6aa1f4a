"""Laws of the search for the samples in which delays lie."""

import numpy as np
import pytest

from sklearn_hd.algorithms.likelihood.delay_search import (
    Cells,
    first_answers,
    scanned,
    through_cells,
)


@pytest.mark.parametrize("free", [False, True])
def test_cells_hold_their_delays(free):
    samples = np.array([2.25, 0.0, 3.0, 0.0, 1.6, 4.0])
    cells = Cells.of(samples, 3, free)
    np.testing.assert_allclose(cells.samples, samples)
    assert np.all((cells.fractions.whole >= 0.0) & (cells.fractions.whole <= 1.0))
    assert np.all(cells.output_lags >= 0)
    np.testing.assert_allclose(cells.with_constant().samples, np.insert(samples, 3, 0.0))


@pytest.mark.parametrize("truth", [[6.4, 2.7], [3.0, 0.0], [0.2, 5.0]])
def test_a_search_goes_from_cell_to_cell(truth):
    visited = []

    def fit(cells, before):
        inside = np.clip(truth - cells.lags, 0.0, 1.0)
        visited.append(tuple(cells.lags))
        found = cells.at(inside)
        return found, found, float(np.sum((found.samples - truth) ** 2))

    _, cells = through_cells(Cells.of([3.0, 2.0], 1, True), fit)
    np.testing.assert_allclose(cells.samples, truth)
    assert len(set(visited)) == len(visited)


def test_a_scan_gives_both_minima_of_two():
    found = scanned(
        np.array([0.0, 5.0]), np.array([0]), 32, lambda s: 1.0 - np.cos(np.pi * (s[0] - 12.0) / 8.0)
    )
    assert {each[0] for each in found} == {12.0, 28.0}


def test_first_answers_of_exact_data_are_the_delays_and_of_noise_none():
    rng = np.random.default_rng(0)
    u, y = rng.standard_normal((400, 2)), np.zeros((400, 2))
    for k in range(7, 400):
        y[k, 0] = 0.8 * y[k - 1, 0] + u[k - 3, 0]
        y[k, 1] = 0.5 * y[k - 1, 1] - 0.2 * y[k - 2, 1] + u[k - 1, 0] + 0.1 * u[k - 6, 1]
    found = first_answers([(u, y, np.zeros(400))], 12, 4)
    np.testing.assert_array_equal(found, [[3.0, np.nan], [1.0, 6.0]])
    noise = rng.standard_normal((400, 1))
    assert np.isnan(first_answers([(u[:, :1], noise, np.zeros(400))], 12, 4)).all()
