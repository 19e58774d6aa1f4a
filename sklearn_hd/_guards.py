"""Guards of public calls: one BLAS thread, and numbers within range.

The matrices of identification are small: more BLAS threads than one cost more than they bring
(twenty times the run time was measured for noisy flapping-wing records on two busy cores).
Overflow ends in an error of ours, not in a warning and infinities.

Warnings that point at the user's line, however deep they arise.
"""

import functools
import os
import sys
import warnings
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import joblib
import numpy as np
import sklearn
from threadpoolctl import ThreadpoolController

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")
BETWEEN = tuple(
    str(Path(file).parent) + os.sep for file in (__file__, sklearn.__file__, joblib.__file__)
)
SEARCHES = "sklearn.model_selection"
ONCE = ("default", "module", "once")
_HELD = ContextVar("held", default=None)
FEW = 6  # names that a message has room for


@functools.cache
def _controller():
    """The BLAS libraries of this process, and the threads they started with."""
    controller = ThreadpoolController().select(user_api="blas")
    return controller, [library["num_threads"] for library in controller.info()]


def one_blas_thread(method):
    """Run a method with one BLAS thread, unless the user has chosen a number.

    A choice is one of the environment variables of the libraries, or a limit
    set through threadpoolctl.
    """

    @functools.wraps(method)
    def limited(*args, **kwargs):
        controller, at_start = _controller()
        now = [library["num_threads"] for library in controller.info()]
        if now != at_start or any(os.environ.get(name) for name in VARIABLES):
            return method(*args, **kwargs)
        with controller.limit(limits=1):
            return method(*args, **kwargs)

    return limited


CACHED = 8192  # rows that fit into a cache


_CANDIDATES = ContextVar("candidates", default=False)


def within_range(call):
    """Turn a failed computation in a method or function into an error with a way out.

    NumPy would warn, and go on with infinities; SLICOT's routines fail on them.
    """

    @functools.wraps(call)
    def checked(*args, **kwargs):
        try:
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                return call(*args, **kwargs)
        except ArithmeticError as error:
            name = type(args[0]).__name__ if "." in call.__qualname__ else call.__name__
            raise ValueError(
                f"{name}: the computation failed ({' '.join(str(error).split())}); the signals, or "
                f"the gains between them, are probably too large or too small for floating-point "
                f"numbers: give inputs and outputs in other units (between 1e-75 and 1e75 nothing "
                f"can overflow)"
            ) from error
        except Exception as error:
            _words_first(error)
            raise

    return checked


def _words_first(error):
    """Let scikit-learn's searches print the message of an error before its traceback.

    A search prints the tracebacks of all fits that failed, some twenty lines for each candidate
    and the words last. Of an error with a cause Python prints the cause first.
    """
    ours = type(error).__module__.partition(".")[0] in ("builtins", "sklearn_hd")
    if ours and error.__cause__ is None and any(searches()):
        error.__cause__ = type(error)(*error.args)


def searches():
    """Frames of the scikit-learn searches and cross-validations that a call is within."""
    frame = sys._getframe(1)
    while frame is not None:
        if frame.f_globals.get("__name__", "").startswith("sklearn.model_selection"):
            yield frame
        frame = frame.f_back


@contextmanager
def candidates():
    """Mark models fitted within as candidates, which give no warnings of their own."""
    token = _CANDIDATES.set(True)
    try:
        yield
    finally:
        _CANDIDATES.reset(token)


def searching():
    """Whether a call is of a candidate of a search, whose score tells what warnings would."""
    return _CANDIDATES.get() or any(
        frame.f_code.co_name == "_fit_and_score" for frame in searches()
    )


def square_sums(signal):
    """Sum of squares of each column, infinite or NaN where it holds such values."""
    sums = np.zeros(signal.shape[1])
    rows = max(1, len(signal)) if signal.flags.f_contiguous else CACHED
    with np.errstate(over="ignore", invalid="ignore"):
        for start in range(0, len(signal), rows):
            sums += [column @ column for column in signal[start : start + rows].T]
    return sums


def extremes(signal):
    """Smallest and largest value of each column; zeros where there is no row."""
    if signal.size == 0:
        return np.zeros((2, signal.shape[1]))
    return np.array([[c.min() for c in signal.T], [c.max() for c in signal.T]])  # not axis=0: slow


def first_of(names):
    """The first six of some names as words, and how many more there are.

    Examples
    --------
    >>> first_of(["b", "c"])
    'b, c'
    >>> first_of(list("abcdefgh"))
    'a, b, c, d, e, f and 2 more'
    """
    more = len(names) - FEW
    return ", ".join(names[:FEW]) + (f" and {more} more" if more > 0 else "")


@contextmanager
def held_back():
    """Hold warnings back until it is known whether they are of the model that is kept.

    It yields a list of (message, category), which are to be given if they are.
    """
    held = []
    token = _HELD.set(held)
    try:
        yield held
    finally:
        _HELD.reset(token)


def warn(message, category):
    """Warn of something, at the nearest line outside this package, scikit-learn and joblib.

    Python shows a warning once for each line and text, but forgets so wherever filters change,
    as in each fit of a search. There it is remembered here, unless the filters say "always", and
    texts count up to the first colon: what follows are figures, in which folds differ.
    """
    if _HELD.get() is not None:
        _HELD.get().append((message, category))
        return
    frame, searched = sys._getframe(1), False
    while frame.f_back is not None and frame.f_code.co_filename.startswith(BETWEEN):
        searched = searched or frame.f_globals.get("__name__", "").startswith(SEARCHES)
        frame = frame.f_back
    module, line = frame.f_globals.get("__name__", "<unknown>"), frame.f_lineno
    told, key = frame.f_globals.setdefault("__warningregistry__", {}), None
    if searched and _action(message, category, module, line) in ONCE:
        key = "in a search", message.partition(": ")[0], category, line
        if told.get(key):
            return
    registry = None if searched else told
    filename = frame.f_code.co_filename
    warnings.warn_explicit(message, category, filename, line, module, registry)
    if key is not None:
        told[key] = 1


def _action(message, category, module, line):
    """What the filters of Python do with a warning."""
    for action, words, kind, where, only in warnings.filters:
        named = issubclass(category, kind) and only in (0, line)
        worded = words is None or words.match(message)
        if named and worded and (where is None or where.match(module)):
            return action
    return warnings.defaultaction
