"""Which faults the tests let by: mutants of the algorithms, a sample of them.

    pip install cosmic-ray
    python docs/benchmarks/mutants.py --sample 100 --seed 0

Cosmic Ray makes the mutants; here they are drawn with a seed, each as likely as any other, and
run, in a copy of the checkout, against the tests that are about them: the module's examples and
mirrored file, then the topic's folder and files that name the module, then the laws, then the
paper and the steps. What survives is printed as a diff; whether it is equivalent is for the
reader to judge. Operators that mostly make nonsense (a | b for a + b, which any test catches)
are left out, so that the share caught means something.
"""

import argparse
import difflib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
ARITHMETIC = ["Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Add", "Pow_Mul"]
COMPARED = ["Eq_NotEq", "NotEq_Eq", "Lt_LtE", "Lt_Gt", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_Lt"]
COMPARED += ["GtE_Gt", "GtE_Lt", "Is_IsNot", "IsNot_Is"]
OPERATORS = [f"core/ReplaceBinaryOperator_{name}" for name in ARITHMETIC]
OPERATORS += [f"core/ReplaceComparisonOperator_{name}" for name in COMPARED]
OPERATORS += ["core/ReplaceUnaryOperator_USub_UAdd", "core/ReplaceUnaryOperator_Delete_Invert"]
OPERATORS += [f"core/{name}" for name in ("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue")]
OPERATORS += [f"core/{name}" for name in ("ReplaceAndWithOr", "ReplaceOrWithAnd", "NumberReplacer")]
OPERATORS += ["core/ZeroIterationForLoop", "core/ReplaceBreakWithContinue"]
LAWS = ["tests/test_laws.py", "tests/test_laws_of_steps.py"]
STEPS = ["tests/test_paper.py", "tests/test_pipeline.py", "tests/test_spurious_modes.py"]
SECONDS = 300  # of one run of tests; a mutant that takes longer hangs, and is caught


def all_mutants():
    """(module, operator, occurrence) of every mutant of the algorithms."""
    from cosmic_ray.ast import ast_nodes, get_ast_from_path
    from cosmic_ray.plugins import get_operator

    found = []
    for path in sorted((ROOT / "sklearn_hd" / "algorithms").glob("*/*.py")):
        nodes = list(ast_nodes(get_ast_from_path(path)))
        for name in OPERATORS:
            operator = get_operator(name)()
            count = sum(len(list(operator.mutation_positions(node))) for node in nodes)
            found += [(path.relative_to(ROOT), name, k) for k in range(count)]
    return found


def tests_of(module):
    """Files to run in turn, the nearest first."""
    topic, name = f"tests/algorithms/{module.parent.name}", rf"\b{module.stem}\b"
    tests = sorted(str(path.relative_to(ROOT)) for path in (ROOT / "tests").rglob("test_*.py"))
    named = [t for t in tests if re.search(name, (ROOT / t).read_text("utf-8"))]
    mirrored = [t for t in tests if t.startswith(topic) and (t in named or module.stem in t)]
    near = [t for t in tests if t.startswith(topic) or t in named]
    near = [t for t in near if t not in (*mirrored, *LAWS, *STEPS)]
    return [[str(module), *mirrored], near, LAWS, STEPS]


def caught_by(module, code, folder, stages):
    """The stage that fails with some code in place of the module's, or None."""
    environment = os.environ | {"PYTHONPATH": folder, "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    target = Path(folder) / module
    original = target.read_text("utf-8")
    target.write_text(code, "utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider"]
    try:
        for stage, files in enumerate(filter(None, tests_of(module)[:stages]), 1):
            run = subprocess.run(
                [*command, *files],
                cwd=folder,
                env=environment,
                capture_output=True,
                timeout=SECONDS,
                check=False,
            )
            if run.returncode not in (0, 5):  # 5: no test at all
                return str(stage)
    except subprocess.TimeoutExpired:
        return f"{stage}, hung"
    finally:
        target.write_text(original, "utf-8")
    return None


def main():
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--sample", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--stages", type=int, default=4, help="2: only the tests nearby")
    parser.add_argument("--only", default="", help="modules whose path holds this")
    arguments = parser.parse_args()
    mutants = [m for m in all_mutants() if arguments.only in str(m[0])]
    drawn = np.random.default_rng(arguments.seed).permutation(len(mutants))[: arguments.sample]
    caught = []
    with tempfile.TemporaryDirectory() as folder:
        keep = shutil.ignore_patterns(".git", "__pycache__", "_build", ".hypothesis")
        shutil.copytree(ROOT, folder, dirs_exist_ok=True, ignore=keep)
        for place in drawn:
            module, name, occurrence = mutants[place]
            code = (ROOT / module).read_text("utf-8")
            mutant = mutate_code(code, get_operator(name)(), occurrence)
            caught.append(caught_by(module, mutant, folder, arguments.stages))
            print(f"{place} {module.stem} {name[5:]} {occurrence}: {caught[-1] or 'SURVIVED'}")
            if caught[-1] is None:
                lines = difflib.unified_diff(code.split("\n"), mutant.split("\n"), n=2, lineterm="")
                print("\n".join(list(lines)[2:]))
            sys.stdout.flush()
    share = np.mean([stage is not None for stage in caught])
    print(f"{len(mutants)} mutants, {len(caught)} drawn, {share:.0%} caught")


if __name__ == "__main__":
    main()
