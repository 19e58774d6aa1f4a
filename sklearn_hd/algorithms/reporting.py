"""Telling how far a computation has come, by a plain callback.

Algorithms that take long have a parameter ``report``: None, where nobody is to be told, or

    report(stage, most, done, note)

called at the start of a stage with ``done=0`` and after each of its steps. ``stage`` says what
is counted, ``most`` how many steps there can be (None: nobody knows), ``note`` where the search
stands. A function of one stage alone is handed ``report(done, note)``, which :func:`stage` makes.
"""

from functools import partial

__all__ = ["stage", "within"]


def stage(report, name, most=None):
    """The callback of one stage, which is announced; None stays None.

    Parameters
    ----------
    report : callable or None
        ``report(stage, most, done, note)``.
    name : str
        What is counted.
    most : int, optional
        Steps that there can be.

    Returns
    -------
    report : callable or None
        ``report(done, note)``.

    Examples
    --------
    >>> heard = []
    >>> told = stage(lambda *words: heard.append(words), "starts", 8)
    >>> told(1, "error 0.1")
    >>> heard
    [('starts', 8, 0, ''), ('starts', 8, 1, 'error 0.1')]
    """
    if report is None:
        return None
    report(name, most, 0, "")
    return partial(report, name, most)


def within(report, words):
    """The same callback with some words after the name of each stage; None stays None.

    Examples
    --------
    >>> within(print, "F 4")("steps", 9, 1, "error 0.1")
    steps (F 4) 9 1 error 0.1
    """
    if report is None:
        return None
    return lambda name, *rest: report(f"{name} ({words})", *rest)
