"""The examples of the README and of the pages run, and say what the text says."""

import re
from pathlib import Path

import matplotlib as mpl

ROOT = Path(__file__).parents[1]


def run(page):
    """What the Python blocks of a page define, one after the other."""
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    namespace = {}
    for block in blocks:
        exec(compile(block, page, "exec"), namespace)
    return text, namespace


def test_the_readme_example_runs(capsys):
    text, namespace = run("README.md")
    assert text.count("```python") == 1
    assert float(capsys.readouterr().out.splitlines()[0]) > 0.99
    assert namespace["y_new"].index.equals(namespace["u"].index)
    assert namespace["pipe"]["match"].system_.nstates == 3


def test_the_frequency_domain_page_runs(capsys):
    mpl.use("Agg")
    text, namespace = run("docs/frequency_domain.md")
    shown = [line.split() for line in capsys.readouterr().out.splitlines()]
    stated = re.search(r"```text\n(.*?)```", text, re.DOTALL).group(1)
    assert shown == [line.split() for line in stated.splitlines()]
    assert 0.8 < namespace["table"]["periodic"].min() < namespace["table"]["periodic"].max() < 1.2
    assert round(namespace["measured"].n_averages) == 189
    mpl.pyplot.close(namespace["figure"])


def test_the_page_on_periodic_models_runs(capsys):
    text, namespace = run("docs/periodic_models.md")
    shown = capsys.readouterr().out.split()
    stated = re.search(r"```text\n(.*?)```", text, re.DOTALL).group(1).split()
    numbers = re.compile(r"[\[\]]*(-?\d+\.?\d*(?:e[+-]\d+)?)")
    for here, there in zip(shown, stated, strict=True):
        if numbers.match(here) and "j" not in here:  # the last digit may differ by machine
            here, there = (float(numbers.match(word).group(1)) for word in (here, there))
            assert abs(here - there) <= 0.02 * abs(there) + 0.1
    assert namespace["hd3"].nstates == 14
