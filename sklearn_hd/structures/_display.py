"""Matrices of structures shown as text and as HTML tables."""

from dataclasses import dataclass
from html import escape

from sklearn_hd.structures._cells import format_cell

_FREE = ' style="text-align:right; font-weight:bold; background:rgba(70,130,180,0.2)"'
_NUMBER = ' style="text-align:right"'
_NAME = ' style="text-align:right; font-weight:normal"'
_TABLE = ' style="color:inherit"'
_CAPTION = ' style="caption-side:top; text-align:center"'
_ROW = ' style="display:flex; flex-wrap:wrap; gap:1.5em; align-items:flex-start"'


@dataclass(frozen=True)
class Table:
    """A matrix to be shown: its letter, the harmonic it belongs to, cells, and names if any."""

    letter: str
    cells: tuple
    rows: tuple | None = None
    columns: tuple | None = None
    harmonic: str = ""


def text_of(parts, notes=()):
    """Text of tables and of lines between and after them."""
    shown = [part if isinstance(part, str) else _text_of_table(part) for part in parts]
    return "\n".join([*shown, *notes])


def _text_of_table(table):
    texts = [[format_cell(cell) for cell in line] for line in table.cells]
    widths = [max(map(len, column)) for column in zip(*texts, strict=True)]
    head = f"{table.letter}_{table.harmonic} = " if table.harmonic else f"{table.letter} = "
    lines = ["[ " + "  ".join(_padded(line, widths)) + " ]" for line in texts] or ["[ ]"]
    return head + ("\n" + " " * len(head)).join(lines)


def _padded(texts, widths):
    return (text.rjust(width) for text, width in zip(texts, widths, strict=True))


def html_of(parts, notes=()):
    """HTML of tables and of lines between and after them: what is free is bold on a ground."""
    tables = "".join(_html_of_table(part) for part in parts if not isinstance(part, str))
    lines = [part for part in parts if isinstance(part, str)] + list(notes)
    below = "".join(f"<div>{escape(line)}</div>" for line in lines)
    return f"<div><div{_ROW}>{tables}</div>{below}</div>"


def _html_of_table(table):
    n_columns = len(table.cells[0]) if table.cells else 0
    rows = range(len(table.cells)) if table.rows is None else table.rows
    columns = range(n_columns) if table.columns is None else table.columns
    caption = f"<i>{table.letter}</i>" + (f"<sub>{table.harmonic}</sub>" if table.harmonic else "")
    head = "".join(f"<th{_NAME}>{escape(str(name))}</th>" for name in columns)
    body = "".join(
        f"<tr><th{_NAME}>{escape(str(name))}</th>{''.join(map(_html_of_cell, line))}</tr>"
        for name, line in zip(rows, table.cells, strict=True)
    )
    return (
        f"<table{_TABLE}><caption{_CAPTION}>{caption}</caption>"
        f"<thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"
    )


def _html_of_cell(cell):
    style = _FREE if cell[1] else _NUMBER
    return f"<td{style}>{escape(format_cell(cell))}</td>"
