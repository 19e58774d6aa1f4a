"""Whatever is given, only what is promised comes out: see fuzzing.py.

300 cases, and 10 000 with ``HYPOTHESIS_PROFILE=nightly``; ``FUZZ_FIRST`` is the number of the
first of them, 0 by default.
"""

import os

import pytest
from conftest import NIGHTLY
from fuzzing import run

TOGETHER = 20  # cases in one test
FIRST = int(os.environ.get("FUZZ_FIRST", "0"))
COUNT = 10_000 if NIGHTLY else 300


@pytest.mark.parametrize("first", range(FIRST, FIRST + COUNT, TOGETHER))
@pytest.mark.slow
def test_only_what_is_promised_comes_out(first):
    outcomes = [run(number) for number in range(first, first + TOGETHER)]
    assert len(outcomes) == TOGETHER
