"""Integration over intervals that are halved until it settles.

A rule gives the integrals of an interval, and a composition those of two neighbours. An interval
whose halves together differ from the whole is halved again: that closes in on a jump until nothing
is lost, and leaves intervals on which the integrand is smooth to a rule of high order.
"""

from functools import lru_cache

import numpy as np

__all__ = ["by_bisection", "gauss_tableau", "neighbours"]

N_STAGES = 7  # collocation of order 14, quadrature exact up to degree 13
MAX_BISECTIONS = 50  # 2⁻⁵⁰ of a period: closer to a jump than rounding tells
MAX_ROUGH = 4096  # intervals open at one time; a few jumps and kinks never come near
BLOCK = 256  # intervals integrated together; bounds the memory


def neighbours(edges):
    """Left and right ends of neighbouring intervals, some hundred at a time."""
    for k in range(0, len(edges) - 1, BLOCK):
        block = edges[k : k + BLOCK + 1]
        yield block[:-1], block[1:]


def by_bisection(rule, compose, weights, left, right, tolerance):
    """What ``rule`` gives for each interval, the intervals halved until it settles.

    ``rule(left, right)`` returns one array per interval, ``compose(second, first)``
    joins those of two neighbours, ``weights(whole)`` scales their differences.
    """
    whole = rule(left, right)
    if not np.all(np.isfinite(whole)):
        raise ValueError("the matrices hold NaN or infinity at some azimuths; make them finite")
    weight = weights(whole)

    def settle(left, right, whole, depth):
        middle = 0.5 * (left + right)
        first, second = rule(left, middle), rule(middle, right)
        halves = compose(second, first)
        axes = tuple(range(1, halves.ndim))
        error = np.max(np.abs(halves - whole) * weight, axis=axes, initial=0.0)
        size = np.max(np.abs(halves) * weight, axis=axes, initial=1.0)
        rough = np.flatnonzero(~(error <= tolerance * size))
        if rough.size > MAX_ROUGH:
            raise ValueError(
                f"{rough.size} intervals of a period are still not resolved to {tolerance:g}; the "
                f"matrices must be smooth in psi but for a few jumps, free of noise"
            )
        if rough.size and depth:
            ends = np.concatenate([left[rough], middle[rough], right[rough]])
            wholes = np.concatenate([first[rough], second[rough]])
            k = rough.size
            fine = settle(ends[: 2 * k], ends[k:], wholes, depth - 1)
            halves[rough] = compose(fine[k:], fine[:k])
        return halves

    return settle(left, right, whole, MAX_BISECTIONS)


@lru_cache(maxsize=4)
def gauss_tableau(n_stages):
    """Nodes c, matrix a and weights b of Gauss collocation on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n_stages)
    legendre = np.polynomial.legendre
    values = legendre.legvander(x, n_stages - 1)
    integrals = np.stack(
        [legendre.legval(x, legendre.legint(row, lbnd=-1.0)) for row in np.eye(n_stages)],
        axis=1,
    )  # ∫ of each Legendre polynomial from −1 to each node
    return 0.5 * (x + 1.0), 0.5 * integrals @ np.linalg.inv(values), 0.5 * w
