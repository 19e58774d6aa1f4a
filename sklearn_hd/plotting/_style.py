"""What all displays share in looks: colours, lines, markers, labels.

Okabe and Ito's palette is told apart by colour-blind readers. Nothing is told by colour
alone: lines differ in dashes, points in their markers, bars in their hatches.
"""

from itertools import cycle, islice

import numpy as np

from sklearn_hd._checks import check_span

BLACK, GREY, LIGHT = "#000000", "#8A8A8A", "#E4E4E4"
ORANGE, SKY, GREEN, BLUE, RED, PURPLE = (
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
)
REFERENCE = {"color": GREY, "lw": 3.0, "ls": "-", "alpha": 0.7}  # measured, or true
LINES = (
    {"color": BLUE, "lw": 1.5, "ls": "-"},
    {"color": RED, "lw": 1.5, "ls": (0, (4, 2))},
    {"color": GREEN, "lw": 1.5, "ls": (0, (5, 1, 1, 1))},
    {"color": PURPLE, "lw": 1.7, "ls": (0, (1, 1))},
    {"color": BLACK, "lw": 1.1, "ls": (0, (7, 2))},
    {"color": ORANGE, "lw": 1.5, "ls": (0, (3, 1, 1, 1, 1, 1))},
)
POINTS = (
    {"color": BLUE, "marker": "o", "ls": "-"},
    {"color": RED, "marker": "s", "ls": (0, (4, 2))},
    {"color": GREEN, "marker": "^", "ls": (0, (5, 1, 1, 1))},
    {"color": PURPLE, "marker": "D", "ls": (0, (1, 1))},
    {"color": BLACK, "marker": "v", "ls": (0, (7, 2))},
    {"color": ORANGE, "marker": "P", "ls": (0, (3, 1, 1, 1, 1, 1))},
)
BARS = (
    {"color": BLUE, "edgecolor": "white"},
    {"color": ORANGE, "edgecolor": "white", "hatch": "//"},
    {"color": GREEN, "edgecolor": "white", "hatch": ".."},
    {"color": PURPLE, "edgecolor": "white", "hatch": "xx"},
    {"color": SKY, "edgecolor": "white", "hatch": "\\\\"},
    {"color": GREY, "edgecolor": "white", "hatch": "++"},
)
TIME, SAMPLES = "time (s)", "sample (–)"
FREQUENCY = "frequency (rad/s)"
REAL, IMAGINARY = "real part (1/s)", "imaginary part (rad/s)"
LEGEND = {"fontsize": 9, "edgecolor": "none", "framealpha": 0.8}  # readable over what it covers
LARGEST = 10.5  # points, the size of titles


def looks(styles, count):
    """As many styles as there are things to draw; the first come again after the last."""
    return list(islice(cycle(styles), count))


def dress(ax, *, x=None, y=None, title=None, small=False):
    """Labels, a faint grid below the data, no frame at the top and on the right."""
    size = {"fontsize": 8} if small else {}
    if x is not None:
        ax.set_xlabel(x, **size)
    if y is not None:
        ax.set_ylabel(y, **size)
    if title is not None:
        ax.set_title(title, loc="left", fontsize=8 if small else LARGEST)
    if small:
        ax.tick_params(labelsize=8)
    ax.grid(True, color=LIGHT, lw=0.6)
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def with_unit(name, units):
    """``w (m/s)`` where the unit of w is known, or that of the signal that w_0 belongs to."""
    unit = unit_of(name, units)
    return str(name) if unit is None else f"{name} ({unit})"


def unit_of(name, units):
    """Unit of a signal, or of a coefficient of it; None where none was given."""
    signal = str(name).rsplit("_", 1)[0]
    return (units or {}).get(name, (units or {}).get(signal))


def number(value):
    """Three digits as print has them: 7.8e8, −0.5."""
    digits, _, power = f"{value:.3g}".partition("e")
    return (f"{digits}e{int(power)}" if power else digits).replace("-", "−")


def complex_number(value):
    """An eigenvalue, or the pair that it stands for, in words of a legend."""
    if abs(value.imag) <= 1e-9 * abs(value):
        return f"{number(value.real)} 1/s"
    return f"{number(value.real)} ± {number(abs(value.imag))}j 1/s"


def unbroken(time, values, segments, span=None):
    """Times and values with a NaN between the segments, so that lines do not cross gaps.

    With ``span`` only those within it.
    """
    times, parts = [], []
    for segment in segments:
        times += [time[segment], [np.nan]]
        parts += [values[segment], np.full((1, *values.shape[1:]), np.nan)]
    times, parts = np.concatenate(times[:-1]), np.concatenate(parts[:-1])
    if span is None:
        return times, parts
    start, stop = check_span("span", span)
    shown = ~((times < start) | (times > stop))  # the breaks, too
    if not np.any(np.isfinite(times[shown])):
        raise ValueError(
            f"span=({start:g}, {stop:g}) holds none of the rows, from t = {time[0]:.6g} s to "
            f"{time[-1]:.6g} s; give times within"
        )
    return times[shown], parts[shown]
