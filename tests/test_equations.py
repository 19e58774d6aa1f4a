"""Equations of docstrings become LaTeX that says the same (docs/equations.py)."""

import importlib.util
import inspect
import re
import unicodedata
from pathlib import Path

import pytest
from test_docstrings import ALL

FILE = Path(__file__).resolve().parent.parent / "docs" / "equations.py"
AS_WRITTEN = {"sklearn_hd.model_selection.simulation_scorer"}  # a call in Python, no equation


@pytest.fixture(scope="module")
def latex():
    spec = importlib.util.spec_from_file_location("equations", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.latex


def packed(text):
    return re.sub(r"\s+", "", text)


@pytest.mark.parametrize(
    ("plain", "expected"),
    [
        ("ẋ = F(ψ) x", r"\dot{x} = F(\psi) x"),
        ("D̂ = D − C_f A_f⁻¹ B_f", r"\hat{D} = D - C_{f} A_{f}^{-1} B_{f}"),
        ("ÿ + ω_i² φ̇²", r"\ddot{y} + \omega_{i}^{2} \dot{\phi}^{2}"),
        ("x0ᵀ X(ψ) x0", r"x_{0}^{\top} X(\psi) x_{0}"),
        ("Σ_n H_n(jΩ) e^{j(Ω + nω)t}", r"\sum_{n} H_{n}(j\Omega) e^{j(\Omega + n\omega)t}"),
        ("ȳ_{k−1} − ȳ*", r"\bar{y}_{k-1} - \bar{y}{}^*"),
        ("√(Σ e² (a)) / 2", r"\sqrt{\sum e^{2} (a)} / 2"),
        ("θ* = arg min_θ ‖W‖_∞", r"\theta{}^* = \arg\min_{\theta} \|W\|_{\infty}"),
        ("[[a, 1], [2c, 0]] x", r"\begin{bmatrix}a & 1 \cr 2c & 0\end{bmatrix} x"),
        ("σ_max  = 12sc dt", r"\sigma_{\max} = 12sc dt"),
        ("y = x,   ψ = ωt   (Eq. 6)", r"y = x,\qquad \psi = \omega t \qquad \text{(Eq. 6)}"),
        ("A_exact in ``x_y``", r"A_{\text{exact}}\ \text{in}\ \texttt{x\_y}"),
    ],
)
def test_signs_become_latex(latex, plain, expected):
    assert packed(latex([plain])) == packed(expected)


def test_functions_stay_apart_from_what_follows(latex):
    assert re.search(r"\\cos\s+k\s", latex(["cos kψ"]))


def test_lines_stand_one_below_the_other(latex):
    assert packed(latex(["    a", "      = b,"])) == packed(r"& a \\ & \quad = b,")


def test_a_long_line_is_broken_between_its_equations(latex):
    long = "x = " + 12 * "a + b + " + "c"
    assert latex([f"{long},   y = x   (Eq. 6)"]).count("\\\\") == 1
    assert "\\\\" not in latex([long])


@pytest.mark.parametrize("plain", ["f(x, **kwargs)", "2 * x", "a ≠ b", "é", "√2", "√(a", "a ∈ ℝ"])
def test_what_the_rule_does_not_know_stays_as_it_is_written(latex, plain):
    assert latex([plain]) is None


def equations(described):
    """Indented blocks ahead of the first section."""
    head = re.split(r"\n\w[\w ]*\n-+\n", inspect.getdoc(described) or "")[0]
    return [block.splitlines() for block in re.findall(r"(?:^    .*\n?)+", head, re.MULTILINE)]


def test_equations_of_all_docstrings_are_known(latex):
    found = {name: equations(described) for name, described in ALL.items()}
    assert sum(map(bool, found.values())) > 50
    unknown = {name for name, blocks in found.items() for block in blocks if latex(block) is None}
    assert unknown == AS_WRITTEN


def test_no_letter_is_lost(latex):
    """Each Latin letter of a docstring's equation is in its LaTeX, in the same order."""
    functions = r"(?<![A-Za-z])(cos|sin|tanh|log|det|min|max|arg|sup)(?![a-z])"
    for name, described in ALL.items():
        for block in equations(described):
            if (found := latex(block)) is not None:
                plain = unicodedata.normalize("NFD", "".join(block)).replace("ᴴ", "H")
                plain = re.sub(functions, "", plain)
                found = re.sub(r"\\[A-Za-z]+|{bmatrix}", "", found)
                letters = [re.sub(r"[^A-Za-z]", "", text) for text in (plain, found)]
                assert letters[0] == letters[1], name
