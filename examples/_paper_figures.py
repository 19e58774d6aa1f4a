"""The figures of ``reproduce_paper.py``, drawn without pyplot so that no display is needed."""

import control
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from sklearn_hd.plotting import (
    BodeDisplay,
    EigenvalueDisplay,
    OrderSelectionDisplay,
    ParticipationDisplay,
    ResponseDisplay,
    SingularValueDisplay,
)

INPUT_AT_REST = 1e-6  # percent of U*
DPI = 150
UNITS = {"Δw": "m/s", "Δφ̇": "rad/s", "ΔU": "% of U*"}
COEFFICIENT_UNITS = {"U": "N m", "w": "m/s", "phi_dot": "rad/s"}
STATE_NAMES = {"w": "(a) vertical speed w", "phi_dot": "(b) flapping speed φ̇"}


def save(figure, folder, number, name):
    """Write ``figure_NN_name.png``, and print a dot."""
    figure.savefig(folder / f"figure_{number:02d}_{name}.png", dpi=DPI)
    print(".", end="", flush=True)


def blank(columns=1, size=(6.4, 4.0), **kwargs):
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(1, columns, **kwargs)


def below(figure, legend):
    """The figure with the legend of a panel moved below all of them."""
    labels = [text.get_text() for text in legend.get_texts()]
    handles = legend.legend_handles
    legend.remove()
    options = {"loc": "outside lower center", "frameon": False, "fontsize": 9}
    figure.legend(handles, labels, ncols=min(4, len(labels)), **options)
    return figure


def participation(shares):
    """Share of each harmonic of a state in that state's motion, by mode (Fig. 1)."""
    figure, axes = blank(2, (7.0, 3.2), sharey=True)
    display = ParticipationDisplay(shares, mode_names=("heave mode", "flap mode"))
    display.plot(axes, state_names=STATE_NAMES)
    return below(figure, display.legend_)


def responses(input_percent, records, seconds):
    """Input, vertical speed and flapping speed of several systems about trim (Figs. 2, 11, 16).

    ``input_percent`` is a Series over time; ``records`` maps a label to a DataFrame of
    perturbations with the columns w and phi_dot, the first of them the one to be met; drawn
    are some seconds from just before the input moves.
    """
    moving = input_percent.index[input_percent.abs() > INPUT_AT_REST]
    tables = {k: y[["w", "phi_dot"]].set_axis(["Δw", "Δφ̇"], axis=1) for k, y in records.items()}
    (first, measured), *others = tables.items()
    figure = Figure(figsize=(7.0, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, gridspec_kw={"height_ratios": (1, 2.2, 2.2)})
    display = ResponseDisplay.from_data(
        measured,
        dict(others),
        inputs=input_percent.rename("ΔU").to_frame(),
        measured_name=first,
        span=(moving[0] - 0.1, moving[0] + seconds),
        units=UNITS,
        ax=axes,
    )
    _zoom(display, moving[-1])
    return below(figure, display.legend_)


def _zoom(display, end):
    """An inset round the end of the input, in the corner that the curves leave empty."""
    axis = display.axes_[1]
    around = slice(end - 0.05, end + 0.08)
    bottom = 0.16 if display.measured["Δw"].loc[around].mean() > 0 else 0.52
    inset = axis.inset_axes((0.68, bottom, 0.31, 0.42))
    lines = [display.measured_lines_["Δw"]]
    lines += [display.simulated_lines_[label, "Δw"] for label in display.simulated]
    for line in lines:
        inside = (line.get_xdata() >= around.start) & (line.get_xdata() <= around.stop)
        look = {"color": line.get_color(), "ls": line.get_linestyle(), "alpha": line.get_alpha()}
        x, y = line.get_xdata()[inside], line.get_ydata()[inside]
        inset.plot(x, y, lw=line.get_linewidth(), **look)
    inset.tick_params(labelsize=8)
    inset.xaxis.set_major_locator(MaxNLocator(3))
    inset.yaxis.set_major_locator(MaxNLocator(3))
    for connector in axis.indicate_inset_zoom(inset, edgecolor="black").connectors:
        connector.set_visible(False)


def singular_values(identifier, title, paper_gap):
    """Singular values, the order taken from their gap, the noise floor, the paper's gap."""
    figure, axis = blank()
    marks = {"paper": paper_gap} if paper_gap != identifier.order_ else None
    SingularValueDisplay.from_estimator(identifier, marks=marks, ax=axis)
    axis.set_title(title, loc="left")
    return figure


def eigenvalues(modes, matched, exact, title):
    """Identified against true: all modes, then the neighbourhoods of the true ones."""
    figure, axes = blank(3, (10.0, 4.0), gridspec_kw={"width_ratios": (1.2, 1, 1)})
    display = EigenvalueDisplay(modes, model=matched, true=exact, model_name="after matching")
    for axis in axes:
        display.plot(axis, legend=False)
    axes[0].set_title(f"{title}: all modes", loc="left")
    heave = exact[np.argmin(np.abs(exact.imag))]
    flap = exact[np.argmax(exact.imag)]
    for axis, centre, least, name in ((axes[1], flap, 9.0, "flap"), (axes[2], heave, 0.4, "heave")):
        axis.set_title(f"near the {name} mode", loc="left")
        miss = matched[np.argmin(np.abs(matched - centre))] - centre
        half = max(least, 1.6 * np.abs(miss.real), 1.6 * np.abs(miss.imag))
        axis.set_xlim(centre.real - half, centre.real + half)
        axis.set_ylim(centre.imag - half, centre.imag + half)
    return below(figure, axes[0].legend(handles=axes[0].get_legend_handles_labels()[0]))


def frequency_responses(exact, systems):
    """Magnitude and phase from U_0 to each coefficient (Fig. 17).

    ``exact`` is (A, B) with the coefficients for states, ``systems`` maps labels to models.
    """
    first = next(iter(systems.values()))
    names = {"inputs": first.input_labels, "outputs": first.output_labels}
    true = control.StateSpace(*exact, np.eye(3), np.zeros((3, 1)), **names)
    figure = Figure(figsize=(9.6, 5.2), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True)
    frequencies = np.geomspace(0.1, 1000.0, 400)
    display = BodeDisplay.from_systems(
        systems, frequencies, true=true, units=COEFFICIENT_UNITS, ax=axes.T.ravel()
    )
    return below(figure, display.legend_)


def order_search(search):
    """Cross-validated misfit by order, with its standard error (Fig. 18)."""
    figure, axis = blank()
    OrderSelectionDisplay.from_estimator(search, misfit=True, ax=axis)
    axis.set_title("GridSearchCV: records held out", loc="left")
    axis.set_ylabel("1 − R² of y(t) (–)")
    return figure
