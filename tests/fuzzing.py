"""Random calls of the public face: what comes of them.

A case is drawn from its number alone: an entry, its parameters, and frames, of which some are
as users mean them and most are spoilt. ``run(number)`` tells what came of it; a Violation says
that something came out which is promised nowhere:

- an exception that is not documented, or that the package did not word itself;
- a warning that is not the package's own (NumPy's, SciPy's, pandas');
- a case that takes longer than some seconds;
- data of the caller's that are changed, or NumPy's global random numbers;
- values that are not finite from a fit that succeeded and warned of nothing;
- another model from the same data.

``python tests/fuzzing.py 0 5000`` runs these cases and counts what came of them.
"""

import collections
import faulthandler
import pickle
import sys
import traceback
import warnings

import numpy as np
from fuzz_promises import (
    DOCUMENTED,
    Violation,
    check_unchanged,
    check_warnings,
    check_worded,
    watched,
)
from fuzzed_calls import draw_call
from threadpoolctl import threadpool_limits


def run(number):
    """What came of a case: "fitted", "done", or the name of a documented exception."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of making the data
        call = draw_call(np.random.default_rng([number, 8]))
    before, random = pickle.dumps(call.data), pickle.dumps(np.random.get_state())  # noqa: NPY002
    try:
        with threadpool_limits(1), watched() as said:
            try:
                outcome = call.perform(said)
            except (*DOCUMENTED, *call.also) as error:
                check_worded(error, (*DOCUMENTED, *call.also))
                outcome = type(error).__name__
        check_warnings(said)
        check_unchanged(call.data, before)
        if pickle.dumps(np.random.get_state()) != random:  # noqa: NPY002
            raise Violation("NumPy's global generator has moved on")
    except Exception as error:
        kind = "" if isinstance(error, Violation) else f"{type(error).__name__} comes out: "
        raise Violation(f"case {number}: {kind}{error}\n{call}") from error
    return outcome


def main(first, stop):
    outcomes = collections.Counter()
    for number in range(first, stop):
        faulthandler.dump_traceback_later(120, exit=True)
        try:
            outcomes[run(number)] += 1
        except Violation as violation:
            outcomes["violation"] += 1
            print(violation, flush=True)
            cause = violation.__cause__ or violation
            print("".join(traceback.format_exception(cause)[-6:]), "-" * 80, flush=True)
    print(dict(outcomes))


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
