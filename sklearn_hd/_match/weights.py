"""Weights of a matching error as people give them: numbers or transfer functions by channel."""

from collections.abc import Mapping
from dataclasses import dataclass
from numbers import Real

import control
import numpy as np
import pandas as pd
from scipy import linalg, signal

_ALLOWED = (
    "a positive number, one for each channel, a dict of them by channel, or a stable transfer "
    "function in continuous time (control or scipy.signal, or a tuple A, B, C, D), for all "
    "channels or by channel in the dict"
)


@dataclass(frozen=True, eq=False)
class ChannelWeights:
    """W of some channels: constants, and what depends on frequency.

    Attributes
    ----------
    constants : ndarray, shape (n_channels,)
    filter : tuple of four ndarray, or None
        A, B, C, D of n_channels inputs and outputs.
    """

    constants: np.ndarray
    filter: tuple | None = None


def read_weights(name, given, channels):
    """The weights of named channels; what is not named in a dict weighs 1.

    Parameters
    ----------
    name : str
        Of the parameter, for messages.
    given : None, number, sequence, mapping, or linear system
    channels : sequence of str

    Returns
    -------
    weights : ChannelWeights
    """
    if given is None:
        return ChannelWeights(np.ones(len(channels)))
    if isinstance(given, Mapping | pd.Series):
        return _by_channel(name, dict(given), list(channels))
    if isinstance(given, Real) and not isinstance(given, bool):
        given = [given] * len(channels)
    if _is_system(given):
        matrices = _matrices(name, given)
        shape = matrices[3].shape
        if shape == (1, 1):
            matrices = _together([matrices] * len(channels))
        elif shape != (len(channels),) * 2:
            raise ValueError(
                f"{name} has {shape[1]} inputs and {shape[0]} outputs, where the model has the "
                f"channels {list(channels)}; give one transfer function, or a square one of "
                f"{len(channels)} channels"
            )
        return ChannelWeights(np.ones(len(channels)), matrices)
    if np.iterable(given) and not isinstance(given, str) and len(given) == len(channels):
        return _by_channel(name, dict(zip(channels, given, strict=True)), list(channels))
    raise ValueError(f"{name}={given!r} is not understood for {list(channels)}; give {_ALLOWED}")


def _by_channel(name, given, channels):
    unknown = [channel for channel in given if channel not in channels]
    if unknown:
        raise ValueError(f"{name} names {unknown}, the model has the channels {channels}")
    constants, filters = np.ones(len(channels)), [None] * len(channels)
    for channel, weight in given.items():
        k = channels.index(channel)
        if isinstance(weight, Real) and not isinstance(weight, bool):
            constants[k] = weight
        elif _is_system(weight):
            filters[k] = _matrices(f"{name}[{channel!r}]", weight)
            if filters[k][3].shape != (1, 1):
                raise ValueError(
                    f"{name}[{channel!r}] has {filters[k][3].shape} outputs and inputs; the weight "
                    f"of one channel has one of each"
                )
        else:
            raise ValueError(f"{name}[{channel!r}]={weight!r} is not understood; give {_ALLOWED}")
    if not (np.all(np.isfinite(constants)) and np.all(constants > 0)):
        raise ValueError(f"{name}={given!r}: weights must be positive and finite; give {_ALLOWED}")
    if not any(filters):
        return ChannelWeights(constants)
    return ChannelWeights(constants, _together([each or _ONE for each in filters]))


_ONE = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.ones((1, 1))


def _is_system(given):
    known = control.StateSpace | control.TransferFunction | signal.lti | signal.dlti
    four = isinstance(given, tuple) and len(given) == 4
    return isinstance(given, known) or (four and not all(isinstance(each, Real) for each in given))


def _matrices(name, system):
    """A, B, C, D of a stable system in continuous time."""
    if not isinstance(system, tuple) and system.dt not in (None, 0):
        raise ValueError(
            f"{name} is in discrete time (dt={system.dt}); the match is made in continuous time, "
            f"so give a continuous transfer function"
        )
    try:
        if isinstance(system, control.TransferFunction):
            system = control.ss(system)
        elif isinstance(system, signal.lti):
            system = system.to_ss()
        if not isinstance(system, tuple):
            system = system.A, system.B, system.C, system.D
        A, B, C, D = (np.atleast_2d(np.asarray(matrix, dtype=float)) for matrix in system)
    except (ValueError, TypeError) as error:
        raise ValueError(
            f"{name}={system!r} has no state-space form ({error}); give {_ALLOWED}"
        ) from error
    if A.size == 0:
        A, B, C = np.zeros((0, 0)), np.zeros((0, D.shape[1])), np.zeros((len(D), 0))
    shapes = [matrix.shape for matrix in (A, B, C, D)]
    n, channels = len(A), len(D)
    fitting = shapes == [(n, n), (n, channels), (channels, n), (channels, channels)]
    if not (fitting and all(np.all(np.isfinite(matrix)) for matrix in (A, B, C, D))):
        raise ValueError(
            f"{name} has matrices of shapes {shapes}, which must be finite and those of a square "
            f"system; give {_ALLOWED}"
        )
    poles = linalg.eigvals(A) if len(A) else np.empty(0)
    if np.any(poles.real >= 0):
        worst = np.real_if_close(poles[np.argmax(poles.real)]) + 0.0  # not -0
        raise ValueError(
            f"{name} has a pole at {worst:.6g}; a weight must be stable, "
            f"such as an integrator moved off the origin, 1/(s + 0.01)"
        )
    return A, B, C, D


def _together(systems):
    """Side by side, each on channels of its own."""
    return tuple(linalg.block_diag(*matrices) for matrices in zip(*systems, strict=True))
