"""A live progress bar (tqdm) for what takes its time, where somebody looks on."""

import sys
import warnings
from contextlib import contextmanager

from sklearn_hd._checks import check_count

KERNEL = "ipykernel.zmqshell"  # loaded behind a notebook, whose stderr is no terminal


@contextmanager
def progress(verbose):
    """What algorithms report to: a bar where it is asked for and can be seen, else None.

        with progress(self.verbose) as report:
            result = some_algorithm(..., report=report)

    The bar stands on stderr if that is a terminal, or in the notebook. Nothing is written into
    a file or a pipe, and nothing is left of the bar after an exception. Warnings that are
    shown meanwhile have lines of their own.

    Parameters
    ----------
    verbose : int
        0 is silent.

    Yields
    ------
    report : callable or None
        As in :mod:`sklearn_hd.algorithms.reporting`.

    Raises
    ------
    ValueError
        If ``verbose`` is neither a whole number of at least zero, nor True or False.
    """
    if check_verbose(verbose) == 0 or not _somebody_looks_on():
        yield None
        return
    bar, show = _Bar(), warnings.showwarning
    warnings.showwarning = bar.beside(show)
    try:
        yield bar
    except BaseException:
        bar.remove()
        raise
    else:
        bar.finish()
    finally:
        warnings.showwarning = show


def _somebody_looks_on():
    return KERNEL in sys.modules or (sys.stderr is not None and sys.stderr.isatty())


def check_verbose(verbose):
    """Return how much is to be told, as an int; True and False count as 1 and 0."""
    given = int(verbose) if isinstance(verbose, bool) else verbose
    return check_count("verbose", given, 0, "0 is silent, 1 shows a progress bar")


class _Bar:
    """One line, whose name, length and count are those of the stage reported last."""

    def __init__(self):
        self._bar, self._stage = None, None

    def __call__(self, stage, most, done, note):
        if self._bar is None:
            self._bar, self._stage = _tqdm(stage, most), stage
        self._bar.set_postfix_str(note, refresh=False)
        if stage != self._stage:
            self._bar.set_description_str(stage, refresh=False)
            self._bar.total = most
            self._bar.reset(most)
        self._stage = stage
        self._bar.update(done - self._bar.n)

    def beside(self, show):
        """Show a warning, by what shows warnings, with the bar out of its way."""

        def shown(*args, **kwargs):
            if self._bar is not None:
                self._bar.clear()
            show(*args, **kwargs)
            if self._bar is not None:
                self._bar.refresh()

        return shown

    def finish(self):
        """Leave the line of the last stage, full: a search that ends early is done, too."""
        if self._bar is None:
            return
        done, since = self._bar.n, self._bar.start_t
        if self._bar.total not in (None, done):
            self._bar.reset(done)
            self._bar.start_t = since
            self._bar.update(done)
        self._bar.close()

    def remove(self):
        """Take the line away."""
        if self._bar is not None:
            self._bar.total = None  # notebooks keep a bar that has not come to its end
            self._bar.leave = False
            self._bar.close()


def _tqdm(stage, most):
    from tqdm.auto import tqdm  # looks for a notebook, which most who import us have no use for

    return tqdm(desc=stage, total=most, miniters=1, dynamic_ncols=True)
