"""The figures of ``reproduce_paper.py``, drawn without pyplot so that no display is needed."""

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from sklearn_hd.algorithms.simulation import frequency_response

# Okabe and Ito's palette: told apart by colour-blind readers, and in grey by its lightness
BLACK, GREY = "#000000", "#8A8A8A"
ORANGE, SKY, GREEN, BLUE, RED, PURPLE = (
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
STYLE = {
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
}
INPUT_AT_REST = 1e-6  # percent of U*
VERDICTS = {  # marker, colour, size, words
    "window": (".", GREY, 6, "window's memory"),
    "copy": ("^", ORANGE, 7, "copy of a genuine mode"),
    "weak": ("s", PURPLE, 5, "weak"),
    "ambiguous": ("D", SKY, 6, "kept, ambiguous"),
    "genuine": ("x", BLUE, 8, "genuine, kept"),
}
MATCHED = ("+", RED, 12, "after matching")
EXACT = ("o", BLACK, 13, "exact")


def styled(draw):
    """Draw within the style above, leaving matplotlib's own settings alone."""

    def drawn(*args, **kwargs):
        with rc_context(STYLE):
            return draw(*args, **kwargs)

    drawn.__doc__ = draw.__doc__
    return drawn


def save(figure, folder, number, name):
    """Write ``figure_NN_name.png`` and return its path."""
    path = folder / f"figure_{number:02d}_{name}.png"
    with rc_context(STYLE):
        figure.savefig(path, dpi=150)
    return path


def blank(rows=1, columns=1, size=(6.4, 4.0), **kwargs):
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots(rows, columns, **kwargs)


@styled
def participation(shares):
    """Share of each harmonic of a state in that state's motion, by mode (Fig. 1)."""
    figure, axes = blank(1, 2, (7.0, 3.2), sharey=True)
    names = {"w": "(a) vertical speed w", "phi_dot": "(b) flapping speed φ̇"}
    for axis, (state, title) in zip(axes, names.items(), strict=True):
        part = shares.loc[state]
        modes = zip(shares.columns, ("heave", "flap"), (BLUE, ORANGE), (-1, 1), strict=True)
        for eigenvalue, mode, colour, side in modes:
            x = part.index.to_numpy() + 0.19 * side
            label = f"{mode} mode, −{-eigenvalue.real:.2f} 1/s"
            bars = axis.bar(x, part[eigenvalue], 0.36, color=colour, label=label)
            axis.bar_label(bars, fmt="%.2f", fontsize=8, padding=2)
        axis.set(title=title, xlabel="harmonic of the state", xticks=part.index)
        axis.grid(False, axis="x")
    axes[0].set(ylabel="modal participation (–)", ylim=(0, 1.12))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


@styled
def responses(input_percent, records, seconds):
    """Input, vertical speed and flapping speed of several systems about trim (Figs. 2, 11, 16).

    ``input_percent`` is a Series over time; ``records`` maps a label to a DataFrame of
    perturbations with the columns w and phi_dot; drawn are some seconds from just before
    the input moves.
    """
    moving = input_percent.index[input_percent.abs() > INPUT_AT_REST]
    span = moving[0] - 0.1, moving[0] + seconds
    heights = {"height_ratios": (1, 2.2, 2.2)}
    figure, axes = blank(3, 1, (7.0, 5.6), sharex=True, gridspec_kw=heights)
    axes[0].plot(input_percent, color=BLACK, lw=1.2, drawstyle="steps-post")
    axes[0].set_ylabel("ΔU (% of U*)")
    looks = [
        {"color": GREY, "lw": 3.0, "alpha": 0.75},
        {"color": BLUE, "lw": 1.6, "ls": "-"},
        {"color": RED, "lw": 1.2, "ls": (0, (4, 2))},
    ]
    looks = looks if len(records) == 3 else [looks[0], looks[2]]
    for (label, y), look in zip(records.items(), looks, strict=True):
        axes[1].plot(y["w"], label=label, **look)
        axes[2].plot(y["phi_dot"], **look)
    axes[1].set_ylabel("Δw (m/s)")
    axes[2].set(ylabel="Δφ̇ (rad/s)", xlabel="time (s)", xlim=span)
    _zoom(axes[1], records, looks, moving[-1])
    figure.legend(*axes[1].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


def _zoom(axis, records, looks, end):
    """An inset round the end of the input, in the corner that the curves leave empty."""
    around = slice(end - 0.05, end + 0.08)
    w = next(iter(records.values()))["w"]
    bottom = 0.16 if w.loc[around].mean() > 0 else 0.52
    inset = axis.inset_axes((0.68, bottom, 0.31, 0.42))
    for y, look in zip(records.values(), looks, strict=True):
        inset.plot(y["w"].loc[around], **look)
    inset.tick_params(labelsize=8)
    inset.xaxis.set_major_locator(MaxNLocator(3))
    inset.yaxis.set_major_locator(MaxNLocator(3))
    for connector in axis.indicate_inset_zoom(inset, edgecolor=BLACK).connectors:
        connector.set_visible(False)


@styled
def singular_values(identifier, title, paper_gap, count=30):
    """Singular values, the order taken from their gap, the noise floor, the paper's gap."""
    figure, axis = blank()
    values = identifier.singular_values_[:count]
    n = np.arange(1, len(values) + 1)
    kept = n <= identifier.order_
    axis.semilogy(n[kept], values[kept], "o", color=BLUE, label=f"order {identifier.order_}")
    axis.semilogy(n[~kept], values[~kept], "o", mfc="white", color=GREY, label="left out")
    axis.axvline(identifier.order_ + 0.5, color=BLUE, lw=1)
    axis.axhline(identifier.noise_floor_, color=RED, ls="--", lw=1.2, label="noise floor")
    if paper_gap != identifier.order_:
        axis.axvline(paper_gap + 0.5, color=ORANGE, ls=":", lw=1.8, label=f"paper: {paper_gap}")
    axis.set(title=title, xlabel="number (–)", ylabel="singular value (scaled outputs)")
    axis.set_xlim(0, len(values) + 1)
    axis.legend(loc="upper right")
    return figure


@styled
def eigenvalues(modes, matched, exact, title):
    """Identified against true: all modes, then the neighbourhoods of the true ones."""
    figure, axes = blank(1, 3, (10.0, 4.0), gridspec_kw={"width_ratios": (1.2, 1, 1)})
    for axis in axes:
        _plot(axis, exact, EXACT, mfc="none", mew=1.4)
        for verdict, look in VERDICTS.items():
            _plot(axis, modes.loc[modes["verdict"] == verdict, "eigenvalue"].to_numpy(), look)
        _plot(axis, matched, MATCHED)
        axis.set(xlabel="real part (1/s)", ylabel="imaginary part (rad/s)")
    axes[0].set_title(f"{title}: all modes")
    heave = exact[np.argmin(np.abs(exact.imag))]
    flap = exact[np.argmax(exact.imag)]
    for axis, centre, least, name in ((axes[1], flap, 9.0, "flap"), (axes[2], heave, 0.4, "heave")):
        axis.set_title(f"near the {name} mode")
        miss = matched[np.argmin(np.abs(matched - centre))] - centre
        half = max(least, 1.6 * np.abs(miss.real), 1.6 * np.abs(miss.imag))
        axis.set_xlim(centre.real - half, centre.real + half)
        axis.set_ylim(centre.imag - half, centre.imag + half)
    shown = [EXACT, *(VERDICTS[v] for v in VERDICTS if v in set(modes["verdict"])), MATCHED]
    handles = [
        Line2D([], [], ls="", marker=m, color=c, ms=s, mew=1.6, mfc="none", label=label)
        for m, c, s, label in shown
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    return figure


def _plot(axis, values, look, mew=1.8, mfc="none"):
    marker, colour, size, _ = look
    axis.plot(values.real, values.imag, marker, color=colour, ms=size, mew=mew, mfc=mfc, ls="")


@styled
def frequency_responses(exact, systems):
    """Magnitude and phase from U_0 to each coefficient (Fig. 17).

    ``exact`` is (A, B) with the coefficients for states, ``systems`` maps labels to models.
    """
    units = {"$w_0$": "m/s", r"$\dot\phi_{1c}$": "rad/s", r"$\dot\phi_{1s}$": "rad/s"}
    looks = [(SKY, "-", 1.6), (BLUE, (0, (5, 2)), 1.6), (RED, (0, (2, 2)), 1.6)]
    omega = np.geomspace(0.1, 1000.0, 400)
    models = [("exact", (*exact, np.eye(3), np.zeros((3, 1))), (GREY, "-", 5.0))]
    models += [
        (label, (system.A, system.B, system.C, system.D), look)
        for (label, system), look in zip(systems.items(), looks, strict=True)
    ]
    figure, axes = blank(2, 3, (9.6, 5.2), sharex=True)
    figure.get_layout_engine().set(h_pad=0.1)  # the dots on the titles' letters
    for label, matrices, (colour, ls, lw) in models:
        style = {"color": colour, "ls": ls, "lw": lw, "label": label}
        G = frequency_response(*matrices, 1j * omega)[:, :, 0]
        for (magnitude, phase), g in zip(axes.T, G.T, strict=True):
            magnitude.loglog(omega, np.abs(g), **style)
            angle = np.degrees(np.unwrap(np.angle(g)))
            phase.semilogx(omega, angle - 360 * np.round(angle[0] / 360), **style)
    for (magnitude, phase), (name, unit) in zip(axes.T, units.items(), strict=True):
        low, high = np.log10(magnitude.get_ylim())
        magnitude.set_ylim(10 ** np.floor(low), 10 ** np.ceil(high))
        magnitude.set(title=f"$U_0$ → {name}", ylabel=f"magnitude ({unit} per N m)")
        phase.set(xlabel="frequency (rad/s)", ylabel="phase (deg)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(models))
    return figure


@styled
def order_search(results):
    """Cross-validated misfit by order, bars from the best fold to the worst (Fig. 18).

    ``results`` has the columns order, block_rows, score, worst and best.
    """
    figure, axis = blank()
    looks = zip(results.groupby("block_rows"), (BLUE, ORANGE), "os", (-0.08, 0.08), strict=True)
    for (rows, part), colour, marker, shift in looks:
        bars = np.abs(part[["best", "worst"]].sub(part["score"], axis=0)).to_numpy().T
        style = {"color": colour, "marker": marker, "capsize": 3, "label": f"{rows} block rows"}
        axis.errorbar(part["order"] + shift, 1 - part["score"], bars, **style)
    axis.set(title="GridSearchCV: records held out", xlabel="order identified (–)")
    axis.set(yscale="log", ylabel="1 − R² of y(t) (–)", xticks=sorted(set(results["order"])))
    axis.legend()
    return figure
