"""How exact floating-point numbers are, and what rounding leaves of nothing.

Whoever asks "is this zero?" asks for one of these.
"""

import numpy as np

EPS = np.finfo(float).eps  # 2.2e-16 of a number, by rounding it
TINY = np.finfo(float).tiny  # the smallest of full precision: has a logarithm and an inverse
EXACT = 2**9 * EPS  # 1e-13 of some data: what is left of what a model explains exactly
DEPENDENT = 2**16 * EPS  # 1.5e-11 of a column's length: dependent ones leave 1e-15 to 1e-13
HALF = np.sqrt(EPS)  # 1.5e-8: half of the digits, what a square root or a double root leaves
RANK = 1e-10  # of the largest singular value, or of a square beside the largest: counts as zero
PRECISION = 1e-9  # of a size: more than long sums leave, less than the best measurements
UNKNOWN = 2**-20  # 1e-6 of a direction in what data do not determine: more than rounding
OVERFLOW = 1e150  # squares of anything larger overflow
