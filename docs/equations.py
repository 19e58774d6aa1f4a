"""Equations of docstrings, which are plain text, as LaTeX.

A docstring is read in an editor and in a terminal too, so its equations are plain text with
the signs of Unicode: ``ẋ = F(ψ) x``, ``D̂ = D − C_f A_f⁻¹ B_f``. The rule is small:

- a letter and its accent are a symbol: ``ẋ`` is ``\\dot{x}``;
- letters or digits after ``_``, braces after ``_`` or ``^``, and digits right after a letter are
  indices; raised signs are exponents;
- ``√(…)`` is a root, ``[[a, b], [c, d]]`` a matrix;
- two spaces or more separate two equations of a line;
- functions, and words of three letters or more, stand upright.

``latex`` returns None for an equation that holds anything else. It then stays as it is written.
"""

import re
import unicodedata

ACCENTS = {"\u0307": "dot", "\u0308": "ddot", "\u0302": "hat", "\u0304": "bar"}
RAISED = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺ᵀᴴ", [*"0123456789-+", r"\top", "H"], strict=True))
SIGNS = {sign: sign for sign in "+-=/()[]|,.;:<>!"} | {
    "−": "-", "·": r"\cdot", "±": r"\pm", "≤": r"\le", "→": r"\to", "…": r"\dots", "∞": r"\infty",
    "∂": r"\partial", "∫": r"\int", "‖": r"\|", "′": "'", "″": "''", "½": r"\tfrac12",
    "Σ": r"\sum", "Π": r"\prod", "*": "{}^*",
}  # fmt: skip
FUNCTIONS = {"cos", "sin", "tanh", "log", "det", "min", "max", "arg", "sup"}
OPERATORS = {"tr", "std", "mean", "SE"}
WIDTH = 75  # signs of plain text that take as much room as the text of a page
SHORT_WORDS = {"of", "in", "so", "or", "to", "is"}
TOKEN = re.compile(
    r"(?P<gap>\s{2,})|(?P<space>\s)|(?P<note>``[^`]+``|\"[^\"]+\"|\(Eqs?\. [^)]*\))"
    r"|(?P<matrix>\[\[.+?\]\])|[_^]\{(?P<braces>[^}]*)\}|_(?P<index>[0-9A-Za-zα-ωΑ-Ω]+)|_(?P<bound>∞)"
    r"|(?P<word>[A-Za-z]+)(?![\u0300-\u036f])|(?P<number>\d+(?:\.\d+)?)"
    rf"|(?P<raised>[{''.join(RAISED)}]+)|√(?=\((?P<root>))"
    r"|(?P<letter>[^\W\d_][\u0300-\u036f]?)|(?P<sign>.)"
)  # fmt: skip


class Unknown(ValueError):
    """A sign that the rule does not know."""


def latex(lines):
    """LaTeX of an equation of one line or several, or None."""
    text = [unicodedata.normalize("NFD", line) for line in lines]
    margin = min(len(line) - len(line.lstrip()) for line in text)
    rows = []
    try:
        for line in text:
            indent = r"\quad " * (len(line) - len(line.lstrip()) > margin)
            rows += [indent + translated(part) for part in shortened(line.strip())]
    except Unknown:
        return None
    return rows[0] if len(rows) == 1 else " \\\\\n".join(f"& {row}" for row in rows)


def shortened(line):
    """The equations of a line that is too long for a page, else the line as it is."""
    long = len(re.sub(r"\s{2,}", "  ", line)) > WIDTH
    return re.split(r"(?<=,)\s{2,}(?![\s=])|\s{2,}(?=\((?!Eq))", line) if long else [line]


def translated(text):
    """LaTeX of plain text on one line."""
    found, place, before = [], 0, "gap"
    while place < len(text):
        token = TOKEN.match(text, place)
        kind, value = token.lastgroup, token[token.lastgroup]
        place = token.end()
        if kind == "gap" and (not found or text[place] == "="):
            kind = "space"  # it aligns the line with its neighbours
        elif kind == "root":
            value, place = within_parentheses(text, place)
        elif kind == "sign" and value == "*" and before in ("gap", "space"):
            raise Unknown(text)  # a product, or the ** of Python
        elif kind == "number" and before in ("word", "letter"):
            kind = "index"
        after = text[place:]
        found.append(piece(kind, value, token[0][0], upright(before, after)))
        before = "upright" if kind == "note" or found[-1].startswith(r"\text{") else kind
    return " ".join(found)


def upright(before, after):
    """Whether a space has a word on one of its sides."""
    word = re.match(r"[A-Za-z]+(?![\u0300-\u036f])", after)
    return before == "upright" or after[:1] in '`"' or bool(word and is_word(word[0]))


def is_word(letters):
    return letters in SHORT_WORDS or (len(letters) > 2 and letters not in FUNCTIONS | OPERATORS)


def within_parentheses(text, start):
    """What stands between the parenthesis at ``start`` and its partner, and where that ends."""
    depth = 0
    for place in range(start, len(text)):
        depth += {"(": 1, ")": -1}.get(text[place], 0)
        if not depth:
            return text[start + 1 : place], place + 1
    raise Unknown(text)


def piece(kind, value, first, beside_a_word):
    """LaTeX of one token."""
    match kind:
        case "gap":
            return r"\qquad"
        case "space":
            return r"\ " if beside_a_word else ""
        case "note":
            font = "text" if value.startswith("(") else "texttt"
            return rf"\{font}{{{value.strip('`')}}}".replace("_", r"\_")
        case "matrix":
            rows = [translated(row).replace(",", " &") for row in value[2:-2].split("], [")]
            return r"\begin{bmatrix}" + r" \cr ".join(rows) + r"\end{bmatrix}"
        case "braces":
            return f"{first}{{{translated(value)}}}"
        case "bound":
            return r"_{\infty}"
        case "index":
            plain = value.isascii() and not is_word(value) and value not in FUNCTIONS
            inside = value if plain else translated(value)
            return f"_{{{inside}}}"
        case "root":
            return rf"\sqrt{{{translated(value)}}}"
        case "raised":
            return "^{" + " ".join(RAISED[sign] for sign in value) + "}"
        case "number":
            return value
        case "word" if value in FUNCTIONS:
            return f"\\{value}"
        case "word" if value in OPERATORS:
            return rf"\operatorname{{{value}}}"
        case "word":
            return rf"\text{{{value}}}" if is_word(value) else value
        case "letter" if value not in SIGNS:
            return symbol(value)
        case _ if value in SIGNS:
            return SIGNS[value]
    raise Unknown(value)


def symbol(value):
    """LaTeX of a letter, Latin or Greek, with its accent."""
    letter, accent = value[0], value[1:]
    if not letter.isascii():
        known = unicodedata.name(letter)
        if not known.startswith(("GREEK SMALL LETTER", "GREEK CAPITAL LETTER")):
            raise Unknown(value)
        _, case, *_, name = known.split()
        name = name.lower().replace("lamda", "lambda")
        letter = "\\" + (name.capitalize() if case == "CAPITAL" else name)
    if accent and accent not in ACCENTS:
        raise Unknown(value)
    return rf"\{ACCENTS[accent]}{{{letter}}}" if accent else letter
