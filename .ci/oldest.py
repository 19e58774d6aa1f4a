"""Write pip constraints that hold every dependency, and dask's, at its bound in pyproject.toml."""

import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parents[1]


def oldest():
    """Lower bounds by name."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    stated = [*project["dependencies"], *project["optional-dependencies"]["dask"]]
    bounds = {}
    for requirement in map(Requirement, stated):
        (bound,) = requirement.specifier
        if bound.operator != ">=":
            raise ValueError(f"{requirement} has no lower bound; write {requirement.name}>=...")
        bounds[requirement.name] = bound.version
    return bounds


if __name__ == "__main__":
    pins = "".join(f"{name}=={version}\n" for name, version in oldest().items())
    Path(sys.argv[1]).write_text(pins, encoding="utf-8")
    print(pins, end="")
