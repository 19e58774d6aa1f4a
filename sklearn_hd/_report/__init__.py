"""The report of a fitted pipeline: one page of HTML that stands by itself.

``page.py`` has the frame of the page, its tables and figures; ``facts.py`` what is read once from
the pipeline and the record; ``sections.py`` one function a section; ``models.py`` those of
the models. All but this module import matplotlib, and are imported when a report is made.
"""

__all__ = ["report"]


def report(pipe, X, y, path, *, validation=None, units=None, title=None):
    """One self-contained HTML page about a fitted model, to send to a colleague.

        R² = 1 − Σ (y − ŷ)² / Σ (y − w − mean)²          as ``score`` has it, at the top

    The page shows the record, how it was read, the order, the modes, the matched model with 95 %
    intervals, tests of the residuals, the validation, every parameter, warnings and versions.
    Doubts stand at the top, each with its figure. Pictures are inside the file; it needs no network
    and no scripts. Where something is missing, one line says why.

    A fitted model does not keep the warnings of its ``fit``. The report makes again those that need
    no fit of the model: of the analyzer, the frequency, exponents in doubt and the inputs.

    Parameters
    ----------
    pipe : Pipeline, search or model step
        Fitted. It ends in :class:`MOESPRegressor`, :class:`SpuriousModeReducer` or
        :class:`StructuredMatcher`.
    X : DataFrame, Series or ndarray, shape (n_samples, n_inputs), or None
        Inputs of the record that was used to fit; None if there were none.
    y : DataFrame, Series or ndarray, shape (n_samples, n_outputs)
        Outputs of that record.
    path : str or path-like
        File to write, such as ``"wing.html"``. A file of that name is replaced.
    validation : (X, y), optional
        A record that was not used to fit, with the same columns.
    units : dict, optional
        Unit of each signal, such as ``{"w": "m/s"}``.
    title : str, optional
        Heading of the page; by default it names the outputs and the inputs.

    Returns
    -------
    path : pathlib.Path
        The file written.

    Raises
    ------
    NotFittedError
        Before ``fit``.
    TypeError
        If the last step is no model step, or the path is no path.
    ValueError
        If the folder of the path does not exist, the path is a folder, or a record does not fit
        the model.

    References
    ----------
    Ljung (1999), System Identification, chapter 16 (model validation).

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from sklearn_hd import MOESPRegressor, report
    >>> u, e = np.random.default_rng(0).standard_normal((2, 400))
    >>> y = np.zeros(400)
    >>> for k in range(1, 400):
    ...     y[k] = 0.8 * y[k - 1] + u[k - 1] + 0.1 * e[k]
    >>> model = MOESPRegressor(order=1, disturbance_model=True).fit(u[:300, None], y[:300])
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = report(
    ...         model, u[:300, None], y[:300], f"{folder}/lag.html",
    ...         validation=(u[300:, None], y[300:]), units={"y0": "m"},
    ...     )
    ...     "Validation" in path.read_text(encoding="utf-8")
    True
    """
    from sklearn_hd._checks import path_to_write
    from sklearn_hd._report.sections import whole_page

    path = path_to_write(path, "report.html")
    if path.suffix.lower() not in (".html", ".htm"):
        raise ValueError(
            f"path={str(path)!r} does not end in .html, and the report is a page of HTML; give "
            f"such a name, and print that page to PDF from a browser"
        )
    path.write_text(whole_page(pipe, X, y, validation, units, title), encoding="utf-8")
    return path
