"""What pyproject.toml allows, what the pages state, and what the sessions of tox run."""

import importlib.util
import os
import re
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

ROOT = Path(__file__).parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = PYPROJECT["project"]
EXTRAS = PROJECT["optional-dependencies"]
STATED = ("numpy", "scipy", "scikit-learn", "pandas", "control")


@pytest.fixture(scope="module")
def bounds():
    path = ROOT / ".ci" / "oldest.py"
    spec = importlib.util.spec_from_file_location("oldest", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.oldest()


@pytest.mark.parametrize("stated", [*PROJECT["dependencies"], *EXTRAS["dask"]])
def test_the_oldest_session_runs_what_is_installed_at_least(stated, bounds):
    """It holds each bound; any other session lies above."""
    requirement = Requirement(stated)
    bound = bounds[requirement.name]
    assert str(requirement.specifier) == f">={bound}"
    if requirement.name in ("dask", "distributed", "pyarrow"):
        pytest.importorskip(requirement.name)
    installed = Version(version(requirement.name))
    assert installed >= Version(bound)
    if os.environ.get("TOX_ENV_NAME") == "oldest":
        assert installed == Version(bound)


def test_extras_agree_on_their_bounds():
    stated = {}
    for requirement in map(Requirement, [text for extra in EXTRAS.values() for text in extra]):
        stated.setdefault(requirement.name, set()).add(str(requirement.specifier))
    assert {name: found for name, found in stated.items() if len(found) > 1} == {}


def test_pages_state_the_bounds(bounds):
    python = re.fullmatch(r">=(3\.\d+)", PROJECT["requires-python"])[1]
    assert sys.version_info >= tuple(map(int, python.split(".")))
    libraries = ", ".join(f"{name} {bounds[name]}" for name in STATED)
    for page, sentence in (
        ("README.md", f"Python {python} or later"),
        ("docs/get_started.md", f"Python {python} or later"),
        ("docs/get_started.md", f"{libraries}, or later"),
    ):
        assert sentence in " ".join((ROOT / page).read_text(encoding="utf-8").split()), page


def test_the_citation_names_this_version_and_the_paper():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    paper = PROJECT["urls"]["Paper"].removeprefix("https://doi.org/")
    assert f"\nversion: {PROJECT['version']}\n" in citation
    assert f"doi: {paper}\n" in citation
    assert f"{{{paper}}}" in (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")
