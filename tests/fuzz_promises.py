"""What any call of the public face promises, whatever it is given."""

import contextlib
import linecache
import pickle
import signal
import traceback
import warnings
from pathlib import Path

import numpy as np
from sklearn.exceptions import ConvergenceWarning, FitFailedWarning, NotFittedError

import sklearn_hd
from sklearn_hd import exceptions

SECONDS = 10  # of computing; waiting for other processes is no fault of the call
WALL_SECONDS = 120
DOCUMENTED = (
    ValueError,
    TypeError,
    NotFittedError,
    exceptions.UnstableModelError,
    exceptions.TrimError,
)
OWN_WARNINGS = tuple(
    kind
    for kind in vars(exceptions).values()
    if isinstance(kind, type) and issubclass(kind, Warning)
)
PACKAGE = Path(sklearn_hd.__file__).parent


class Violation(AssertionError):
    """Something that no documentation promises."""


class Hang(BaseException):
    """A call takes longer than it may; nothing catches this on the way."""


@contextlib.contextmanager
def watched():
    """The warnings of what is done within, which is broken off after some seconds."""

    def ring(_, frame):
        raise Hang(f"{frame.f_code.co_filename}:{frame.f_lineno}")

    former = [signal.signal(each, ring) for each in (signal.SIGPROF, signal.SIGALRM)]
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    signal.setitimer(signal.ITIMER_REAL, WALL_SECONDS)
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            yield said
    except Hang as hang:
        raise Violation(f"takes longer than {SECONDS} s, in {hang}") from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for each, handler in zip((signal.SIGPROF, signal.SIGALRM), former, strict=True):
            signal.signal(each, handler)


def check_worded(error, documented=DOCUMENTED):
    """Raise Violation unless the package, or scikit-learn for it, raised the error in its words."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    path = Path(frame.filename)
    line = linecache.getline(frame.filename, frame.lineno).strip()
    ours = PACKAGE in path.parents or "sklearn" in path.parts
    own = type(error).__module__.partition(".")[0] == PACKAGE.name  # of a documented kind
    if not (ours and (own or type(error) in documented) and line.startswith("raise")):
        raise Violation(
            f"{type(error).__name__} not worded by the package: {error}\nat "
            f"{path.name}:{frame.lineno}: {line}"
        ) from error


def check_warnings(said):
    """Raise Violation for a warning that is not the package's own."""
    for warning in said:
        if not issubclass(warning.category, (*OWN_WARNINGS, ConvergenceWarning, FitFailedWarning)):
            raise Violation(
                f"{warning.category.__name__} gets out: {warning.message}\nat "
                f"{warning.filename}:{warning.lineno}"
            )


def check_unchanged(data, before):
    """Raise Violation unless containers hold what they held when they were pickled."""
    if pickle.dumps(data) == before:
        return
    for one, other in zip(data, pickle.loads(before), strict=True):
        if not _same(one, other):
            raise Violation("data of the caller's are changed")


def _same(one, other):
    if hasattr(one, "equals"):
        return one.equals(other) and one.index.equals(other.index)
    if isinstance(one, np.ndarray) and one.dtype.kind != "O":
        return one.tobytes() == other.tobytes()
    return repr(one) == repr(other)
