"""Warnings that point at the user's line, however deep they arise, and are shown there once."""

import os
import sys
import warnings
from pathlib import Path

import joblib
import sklearn

__all__ = ["warn"]

BETWEEN = tuple(
    str(Path(file).parent) + os.sep for file in (__file__, sklearn.__file__, joblib.__file__)
)
ONCE = ("default", "module", "once")


def warn(message, category):
    """Warn of something, at the nearest line outside this package, scikit-learn and joblib.

    Python shows a warning once for each line and text, but forgets so wherever filters change,
    as in each fit of a search: here it is remembered, unless the filters say "always". Texts
    count up to the first colon: what follows are figures, in which folds differ.

    Parameters
    ----------
    message : str
    category : type
        Of warning.
    """
    frame = sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(BETWEEN):
        frame = frame.f_back
    module = frame.f_globals.get("__name__", "<unknown>")
    told = frame.f_globals.setdefault("__warningregistry__", {})
    key = message.partition(": ")[0], category, frame.f_lineno
    once = _action(message, category, module, frame.f_lineno) in ONCE
    if once and told.get(key):
        return
    warnings.warn_explicit(message, category, frame.f_code.co_filename, frame.f_lineno, module)
    if once:
        told[key] = 1


def _action(message, category, module, line):
    """What the filters of Python do with a warning."""
    for action, words, kind, where, only in warnings.filters:
        named = issubclass(category, kind) and only in (0, line)
        worded = words is None or words.match(message)
        if named and worded and (where is None or where.match(module)):
            return action
    return warnings.defaultaction
