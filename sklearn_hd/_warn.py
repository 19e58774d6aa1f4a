"""Warnings that point at the user's line, however deep they arise."""

import os
import sys
import warnings
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

import joblib
import sklearn

BETWEEN = tuple(
    str(Path(file).parent) + os.sep for file in (__file__, sklearn.__file__, joblib.__file__)
)
SEARCHES = "sklearn.model_selection"
ONCE = ("default", "module", "once")
_HELD = ContextVar("held", default=None)


@contextmanager
def held_back():
    """Hold warnings back until it is known whether they are of the model that is kept.

    Yields
    ------
    held : list of (message, category)
        To be given, each, if it is.
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

    Parameters
    ----------
    message : str
    category : type
        Of warning.
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
