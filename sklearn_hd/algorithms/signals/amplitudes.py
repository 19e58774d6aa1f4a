"""The linear part of responses to one waveform at several amplitudes.

A nonlinear system answers the input a·u(t) with a power series in a,

    y(t; a) = a y_1(t) + a² y_2(t) + … ,

of which only y_1 is the response of its linearisation. Records at amplitudes
a_1, a_2, … hold y_1 in a combination that no other power enters:

    Σ_r w_r a_r = a_max,   Σ_r w_r a_r^p = 0  (p = 2 … q)
        ⇒   Σ_r w_r y(t; a_r) = a_max y_1(t) + O(a^{q+1}).

For the pair ±a, w = (½, −½): the odd part, wrong by a³ y_3 only. The same
combination is taken of the inputs, so that amplitudes need not be known
exactly for input and output to belong together. White noise of one size in
each record becomes ‖w‖ times as large (0.71 for a pair).
"""

import numpy as np

SAME_WAVEFORM = 0.1  # share of an input that may be no multiple: noise of 1/20 on both gives 0.07
SAME_SIZE = 0.05  # share by which two amplitudes differ that were meant to be alike


def same_waveform(inputs):
    """Records whose inputs are multiples of one waveform, and the multiples.

    Parameters
    ----------
    inputs : list of ndarray, shapes (n_samples_r, n_inputs)
        One a record, on the same grid from the first row on. Lengths may
        differ: the rows that two records share are compared.

    Returns
    -------
    groups : list of (indices, amplitudes)
        Amplitudes are multiples of the largest input of the group, which
        comes first with amplitude 1. A record at rest stands alone with
        amplitude 0.

    Examples
    --------
    >>> u = np.array([[0.0], [1.0], [-1.0]])
    >>> [(rows.tolist(), a.tolist()) for rows, a in same_waveform([u, -2 * u, 0 * u])]
    [([1, 0], [1.0, -0.5]), ([2], [0.0])]
    """
    scale = np.sqrt(np.mean(np.vstack([u**2 for u in inputs]), axis=0))
    inputs = [u / np.where(scale > 0.0, scale, 1.0) for u in inputs]
    left = sorted(range(len(inputs)), key=lambda r: -np.linalg.norm(inputs[r]))
    groups = []
    while left:
        waveform, members, amplitudes = inputs[left[0]], [], []
        for r in left:
            n = min(len(waveform), len(inputs[r]))
            u, v = inputs[r][:n], waveform[:n]
            a = float(np.vdot(v, u) / (np.vdot(v, v) or 1.0))
            if r == left[0] or np.linalg.norm(u - a * v) <= SAME_WAVEFORM * np.linalg.norm(u):
                members.append(r)
                amplitudes.append(a)
        moving = np.array(amplitudes) != 0.0  # zero is a multiple of anything
        if moving[0]:
            members = [r for r, moves in zip(members, moving, strict=True) if moves]
            amplitudes = [a for a in amplitudes if a != 0.0]
        else:
            members, amplitudes = members[:1], amplitudes[:1]
        groups.append((np.array(members), np.array(amplitudes)))
        left = [r for r in left if r not in members]
    return groups


def extrapolation_weights(amplitudes):
    """Weights w of the records that leave the linear term, at the largest amplitude.

    As many powers are told apart as there are distinct amplitudes; records of
    one amplitude are averaged.

    Parameters
    ----------
    amplitudes : array_like, shape (n_records,)
        Signed, none of them zero.

    Returns
    -------
    weights : ndarray, shape (n_records,)

    Examples
    --------
    >>> extrapolation_weights([1.0, -1.0]).tolist()
    [0.5, -0.5]
    >>> extrapolation_weights([2.0, 1.0]).round(12).tolist()
    [-1.0, 4.0]
    """
    amplitudes = np.asarray(amplitudes, dtype=float)
    largest = amplitudes[np.argmax(np.abs(amplitudes))]
    a = amplitudes / largest
    powers = a[:, None] ** np.arange(1, n_distinct(a) + 1)
    # rounded to what the amplitudes are known to, so that ± pairs give ± ½ to the last digit
    return np.linalg.pinv(powers)[0].round(14)


def n_distinct(amplitudes):
    """Number of amplitudes that differ by more than what two meant to be alike do.

    Examples
    --------
    >>> n_distinct([1.0, 0.98, -1.0, 0.5])
    3
    """
    a = np.sort(np.asarray(amplitudes, dtype=float))
    size = np.maximum(np.abs(a[:-1]), np.abs(a[1:]))
    return 1 + int(np.sum(np.diff(a) > SAME_SIZE * size))


def odd_weights(amplitudes):
    """Weights of the records for each pair ±a, and the records without a partner.

    Records of one amplitude and sign are averaged. Sizes that differ by up to
    5 % make a pair; their quadratic terms cancel all the same.

    Parameters
    ----------
    amplitudes : array_like, shape (n_records,)
        As for :func:`extrapolation_weights`.

    Returns
    -------
    weights : ndarray, shape (n_pairs, n_records)
    single : list of int
        Records whose amplitude stands there with one sign only.

    Examples
    --------
    >>> weights, single = odd_weights([1.0, -1.0, 0.5])
    >>> weights.tolist(), single
    ([[0.5, -0.5, 0.0]], [2])
    """
    a = np.asarray(amplitudes, dtype=float)
    order = np.argsort(-np.abs(a), kind="stable")
    sizes = np.abs(a[order])
    breaks = np.flatnonzero(sizes[:-1] - sizes[1:] > SAME_SIZE * sizes[:-1]) + 1
    rows, single = [], []
    for members in np.split(order, breaks):
        if np.all(a[members] > 0.0) or np.all(a[members] < 0.0):
            single += members.tolist()
            continue
        row = np.zeros(len(a))
        for sign, mean in zip((1.0, -1.0), _pair_weights(a[members]), strict=True):
            side = members[np.sign(a[members]) == sign]
            row[side] = mean / len(side)
        rows.append(row)
    return np.array(rows).reshape(-1, len(a)), sorted(single)


def _pair_weights(a):
    """Weights of the mean positive and the mean negative record."""
    plus, minus = float(np.mean(a[a > 0.0])), float(np.mean(a[a < 0.0]))
    weights = extrapolation_weights([plus, minus]) if plus != -minus else np.array([0.5, -0.5])
    return weights if plus >= -minus else -weights
