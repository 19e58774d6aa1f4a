"""Build sdist and wheel, look into them, and run the tests on the installed wheel, elsewhere.

``python .ci/outside.py [pytest arguments]``: the default suite, or what the arguments say, in a
copy of the sdist without the package; ``--pyargs sklearn_hd`` stands for the package's doctests.
Needs build and twine.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
STEM = f"{PROJECT['name']}-{PROJECT['version']}"
TOP = {".ci", ".gitignore", "LICENSE", "PKG-INFO", "README.md", "pyproject.toml"}
TOP |= {"docs", "examples", "sklearn_hd", "tests"}
MADE = {"__pycache__", "_build", "auto_examples", "gallery_backreferences", ".hypothesis"}


def run(*command, **options):
    """Run a command, with nothing of the checkout on Python's path."""
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    subprocess.run([str(part) for part in command], check=True, env=clean, **options)


def require(condition, message):
    """End with a message unless the condition holds."""
    if not condition:
        raise SystemExit(f"outside.py: {message}")


def build(work):
    """The sdist, and the wheel made of it, which is the checkout's own byte by byte."""
    made, direct = work / "dist", work / "direct"
    run(sys.executable, "-m", "build", "--outdir", made, ROOT)
    run(sys.executable, "-m", "build", "--wheel", "--outdir", direct, ROOT)
    (sdist,), (wheel,), (other,) = made.glob("*.tar.gz"), made.glob("*.whl"), direct.glob("*.whl")
    require(
        wheel.read_bytes() == other.read_bytes(), "the sdist's wheel is not that of the checkout"
    )
    run(sys.executable, "-m", "twine", "check", "--strict", sdist, wheel)
    return sdist, wheel


def files_of(*tops):
    """Files below some directories of the checkout, from its root on."""
    paths = [path for top in tops for path in (ROOT / top).rglob("*") if path.is_file()]
    return {path.relative_to(ROOT).as_posix() for path in paths if not MADE & set(path.parts)}


def check_contents(sdist, wheel):
    """The wheel: package and licences only. The sdist: the tests too, nothing made of it."""
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    info, package = f"{STEM}.dist-info/", files_of("sklearn_hd")
    code = {name for name in packed if not name.startswith(info)}
    require(code == package, f"wheel and package differ by {code ^ package}")
    licences = [path for pattern in PROJECT["license-files"] for path in ROOT.glob(pattern)]
    missing = {f"{info}licenses/{path.relative_to(ROOT).as_posix()}" for path in licences} - packed
    require(licences and not missing, f"the wheel lacks {missing or 'licences'}")
    with tarfile.open(sdist) as archive:
        members = [Path(member.name) for member in archive.getmembers() if member.isfile()]
    stored = {path.relative_to(STEM).as_posix() for path in members}
    top = {name.partition("/")[0] for name in stored}
    require(top == TOP, f"the sdist's top level differs by {top ^ TOP}")
    made = {str(path) for path in members if MADE & set(path.parts)}
    require(not made, f"the sdist holds {made}")
    missing = files_of("sklearn_hd", "tests", ".ci") - stored
    require(not missing, f"the sdist lacks {missing}")
    print(f"{wheel.name}: {len(packed)} files; {sdist.name}: {len(stored)} files", flush=True)


def install(wheel, work):
    """Python of a fresh environment that holds the wheel and what the tests need."""
    home = work / "venv"
    venv.create(home, with_pip=True)
    python = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
    run(python, "-m", "pip", "install", "-q", f"{wheel}[test]")
    return python


def test(python, sdist, work, arguments):
    """Run pytest beside the sdist's tests, pages and examples, where no package lies."""
    shutil.unpack_archive(sdist, work)
    here = work / STEM
    require(not here.is_relative_to(ROOT), f"{here} lies in the checkout; set TMPDIR elsewhere")
    shutil.rmtree(here / "sklearn_hd")
    told = "import sklearn_hd, sys; print(p := sklearn_hd.__file__); sys.exit(sys.argv[1] not in p)"
    run(python, "-c", told, os.sep + "site-packages" + os.sep, cwd=here)
    chosen = arguments or ["tests", "--pyargs", "sklearn_hd"]
    run(python, "-m", "pytest", "-n", "auto", "--rootdir", here, *chosen, cwd=here)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        work = Path(scratch).resolve()
        sdist, wheel = build(work)
        check_contents(sdist, wheel)
        test(install(wheel, work), sdist, work, sys.argv[1:])
