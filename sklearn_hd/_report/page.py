"""The frame of the page: its style, and values, tables and figures as HTML."""

import base64
from contextlib import contextmanager
from html import escape
from io import BytesIO
from string import Template

import matplotlib.pyplot as plt
import numpy as np

from sklearn_hd.exceptions import UnstableModelError
from sklearn_hd.plotting._display import number

REFUSALS = (ValueError, TypeError, AttributeError, UnstableModelError, np.linalg.LinAlgError)
PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$title</title>
<style>
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff;
  max-width: 60rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0.5rem 0; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; border-bottom: 1px solid #bbb; margin: 2rem 0 0.5rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 0.3rem; }
p, li { max-width: 46rem; overflow-wrap: anywhere; }
nav a { margin-right: 0.8rem; white-space: nowrap; }
.box { border-left: 5px solid #009e73; background: #eef8f4; padding: 0.3rem 1rem; margin: 1rem 0; }
.doubt { border-color: #d55e00; background: #fdf1e8; }
.note { color: #555; font-size: 0.9rem; }
.wide { overflow-x: auto; }
.wide img { min-width: 28rem; max-width: 100%; }
table { border-collapse: collapse; margin: 0.6rem 0; font-size: 0.9rem;
  font-variant-numeric: tabular-nums; }
th, td { padding: 0.15rem 0.6rem; border-bottom: 1px solid #e4e4e4; text-align: right;
  vertical-align: top; white-space: nowrap; }
th, td.words { text-align: left; font-weight: normal; }
.facts th { white-space: normal; min-width: 6rem; }
td.words { white-space: normal; min-width: 9rem; overflow-wrap: anywhere; }
thead th { font-weight: 600; border-bottom: 1px solid #888; text-align: right; }
thead th:first-child, thead th.words { text-align: left; }
tbody th { color: #333; }
details { margin: 0.5rem 0; }
@media print {
  body { font-size: 10pt; max-width: none; padding: 0; }
  nav { display: none; }
  .wide { overflow: visible; }
  table { font-size: 7.5pt; }
  th, td { padding: 0.1rem 0.3rem; }
  .wide img { min-width: 0; max-width: 100%; }
  figure, tr, .box { break-inside: avoid; }
  h2, h3 { break-after: avoid; }
}
figure { margin: 0.8rem 0; }
</style>
</head>
<body>
<h1>$title</h1>
$head
<nav>$contents</nav>
$body
</body>
</html>
""")


def page(title, head, sections):
    """The whole page of some sections, (anchor, heading, HTML) each."""
    contents = " ".join(f'<a href="#{a}">{escape(h)}</a>' for a, h, _ in sections)
    body = "\n".join(
        f'<section id="{anchor}"><h2>{escape(heading)}</h2>\n{inner}\n</section>'
        for anchor, heading, inner in sections
    )
    return PAGE.substitute(title=escape(title), head=head, contents=contents, body=body)


def line(text, kind=None):
    """A paragraph of plain text."""
    style = "" if kind is None else f' class="{kind}"'
    return f"<p{style}>{escape(text)}</p>"


def digits(value, count=4):
    """A number in some digits, or text as it is; an en dash where there is none."""
    if isinstance(value, str):
        return value
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if np.iscomplexobj(value):
        size = digits(abs(value.imag), count)
        if abs(value.imag) <= 1e-9 * abs(value):
            return digits(value.real, count)
        return f"{digits(value.real, count)} {'+' if value.imag > 0 else '−'} {size}j"
    if value is None or np.isnan(value):
        return "–"
    if isinstance(value, int | np.integer):
        return f"{value:d}".replace("-", "−")
    return number(value, count)


def with_reach(value, reach):
    """A value and the half width of its interval, both to two digits of the latter."""
    if np.isnan(value) or not np.isfinite(reach) or reach <= 0.0:
        known = "" if np.isnan(value) or np.isnan(reach) or reach == 0.0 else f" ± {reach:g}"
        return digits(value) + known
    size = int(np.floor(np.log10(max(abs(value), reach))))
    power = 0 if -4 <= size < 6 else size
    unit = 10.0**power
    places = int(np.clip(1 - np.floor(np.log10(reach / unit)), -300, 9))
    rounded = (f"{round(x / unit, places):.{max(places, 0)}f}" for x in (value, reach))
    text = " ± ".join(rounded)
    return (f"({text})e{power}" if power else text).replace("-", "−")


def table(frame, words=()):
    """A DataFrame as a table of HTML; columns of words are set to the left."""

    def cell(name, value, kind="td"):
        style = ' class="words"' if name in words else ""
        return f"<{kind}{style}>{escape(digits(value))}</{kind}>"

    head = "".join(cell(name, str(name), "th") for name in frame.columns)
    rows = "".join(
        f'<tr><th scope="row">{escape(str(label))}</th>'
        + "".join(cell(*each) for each in zip(frame.columns, values, strict=True))
        + "</tr>"
        for label, *values in frame.itertuples()
    )
    first = "" if frame.index.name is None else escape(str(frame.index.name))
    head = f"<thead><tr><th>{first}</th>{head}</tr></thead>"
    return f'<div class="wide"><table>{head}<tbody>{rows}</tbody></table></div>'


def facts_table(facts):
    """A table of names and what they are; None leaves a row out."""
    rows = "".join(
        f'<tr><th scope="row">{escape(name)}</th>'
        f'<td class="words">{escape(digits(value))}</td></tr>'
        for name, value in facts.items()
        if value is not None
    )
    return f'<div class="wide"><table class="facts"><tbody>{rows}</tbody></table></div>'


def figure(draw, caption):
    """What ``draw`` draws, a display, as a picture within the page; a line where it refuses."""

    def drawn():
        display = draw()
        stored = BytesIO()
        display.figure_.savefig(stored, format="png", dpi=144, facecolor="white")
        data = base64.b64encode(stored.getvalue()).decode()
        width = round(96 * display.figure_.get_size_inches()[0])  # pixels an inch
        text = escape(caption)
        return (
            f'<figure><div class="wide"><img alt="{text}" width="{width}" '
            f'src="data:image/png;base64,{data}"></div>'
            f'<figcaption class="note">{text}</figcaption></figure>'
        )

    with plt.ioff():
        return attempt(drawn, f"There is no picture here ({caption.rstrip('.')})")


@contextmanager
def closed_figures():
    """Close the figures that are made meanwhile."""
    before = set(plt.get_fignums())
    try:
        yield
    finally:
        for number in set(plt.get_fignums()) - before:
            plt.close(number)


def attempt(make, missing):
    """The HTML that something makes, or one line that says why it cannot."""
    try:
        return make()
    except REFUSALS as error:
        return line(f"{missing}: {error}", "note")
