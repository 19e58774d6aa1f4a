"""Overflow ends in an error of ours, not in a warning and infinities."""

import functools

import numpy as np


def within_range(method):
    """Turn a breakdown of the arithmetic in a method into an error that names the way out.

    NumPy would warn, and go on with infinities; SLICOT's routines fail on them.
    """

    @functools.wraps(method)
    def checked(self, *args, **kwargs):
        try:
            with np.errstate(over="raise", divide="raise", invalid="raise"):
                return method(self, *args, **kwargs)
        except ArithmeticError as error:
            raise ValueError(
                f"{type(self).__name__}: the arithmetic broke down "
                f"({' '.join(str(error).split())}); the signals, or the gains between them, are "
                f"probably too large or too small for floating-point numbers: give inputs and "
                f"outputs in other units (between 1e-75 and 1e75 nothing can overflow)"
            ) from error

    return checked
