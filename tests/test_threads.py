"""One BLAS thread where the user has not chosen, the user's number where they have."""

import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

from sklearn_hd._guards import VARIABLES, one_blas_thread


def blas_threads():
    libraries = ThreadpoolController().select(user_api="blas").info()
    return {library["num_threads"] for library in libraries}


threads = one_blas_thread(blas_threads)


@pytest.fixture
def no_choice(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)


@pytest.mark.usefixtures("no_choice")
def test_one_thread_by_default():
    before = blas_threads()
    assert threads() == {1}
    assert blas_threads() == before


def test_an_environment_variable_is_a_choice(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with threadpool_limits(2):
        assert threads() == {2}


@pytest.mark.usefixtures("no_choice")
def test_a_limit_of_threadpoolctl_is_a_choice():
    threads()  # the numbers at the start are known from here on
    with threadpool_limits(3):
        assert threads() == {3}
