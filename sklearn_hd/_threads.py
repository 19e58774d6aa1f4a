"""Thread counts of the linear algebra underneath.

The matrices of identification are small: more BLAS threads than one cost more
than they bring (twenty times the run time was measured for noisy flapping-wing
records on two busy cores).
"""

import functools
import os

from threadpoolctl import ThreadpoolController

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


@functools.cache
def _controller():
    """The BLAS libraries of this process, and the threads they started with."""
    controller = ThreadpoolController().select(user_api="blas")
    return controller, [library["num_threads"] for library in controller.info()]


def one_blas_thread(method):
    """Run a method with one BLAS thread, unless the user has chosen a number.

    A choice is one of the environment variables of the libraries, or a limit
    set through threadpoolctl.
    """

    @functools.wraps(method)
    def limited(*args, **kwargs):
        controller, at_start = _controller()
        now = [library["num_threads"] for library in controller.info()]
        if now != at_start or any(os.environ.get(name) for name in VARIABLES):
            return method(*args, **kwargs)
        with controller.limit(limits=1):
            return method(*args, **kwargs)

    return limited
