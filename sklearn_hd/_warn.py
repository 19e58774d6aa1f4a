"""Warnings that point at the user's line, however deep they arise."""

import os
import sys
import warnings
from pathlib import Path

__all__ = ["warn"]

HERE = str(Path(__file__).parent) + os.sep


def warn(message, category):
    """Warn of something, at the nearest line outside this package.

    Parameters
    ----------
    message : str
    category : type
        Of warning.
    """
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None and frame.f_code.co_filename.startswith(HERE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
