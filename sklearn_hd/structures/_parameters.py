"""What may be said of parameters by name: a value to hold, where to start, between what bounds."""

from collections.abc import Mapping

import numpy as np
import pandas as pd

from sklearn_hd.structures._cells import finite_number


def read_fixed(given, names=None):
    """{name: number} of parameters that are known; the names must be among some."""
    fixed = {
        name: _number(f"fixed value of {name!r}", value)
        for name, value in _mapping("fixed", given, "{'k': 2.0}").items()
    }
    if names is not None:
        check_known("fixed", fixed, names)
    return fixed


def join_fixed(fixed, more):
    """Both, where they do not contradict each other."""
    for name, value in more.items():
        if fixed.get(name, value) != value:
            raise ValueError(
                f"{name!r} is fixed at {fixed[name]:g} already and cannot be {value:g} too; "
                f"free([{name!r}]) first"
            )
    return {**fixed, **more}


def freed(fixed, names):
    """Names to be freed, all by default, after checking that they are fixed."""
    if names is None:
        return tuple(fixed)
    if isinstance(names, str) or not np.iterable(names):
        raise ValueError(f"free({names!r}): give a list of names, such as ['k']")
    names = tuple(names)
    unknown = [name for name in names if name not in fixed]
    if unknown:
        raise ValueError(f"{unknown} are not fixed, so cannot be freed; fixed are {list(fixed)}")
    return names


def read_bounds(given, names):
    """{name: (low, high)}, None for an open end; names without any bound are left out."""
    given = _mapping("bounds", given, "{'k': (0.0, None)}")
    check_known("bounds", given, names)
    bounds = {name: _interval(name, ends) for name, ends in given.items()}
    return {name: ends for name, ends in bounds.items() if ends != (None, None)}


def _interval(name, given):
    try:
        low, high = given
        low, high = _end(low, -np.inf), _end(high, np.inf)
    except (TypeError, ValueError, OverflowError):
        low = high = np.nan
    if not low < high:
        raise ValueError(
            f"bounds of {name!r} are {given!r}; give (low, high) with low < high, None where it is "
            f"open; one value alone is given by fixed"
        )
    return tuple(float(end) if np.isfinite(end) else None for end in (low, high))


def _end(value, unbounded):
    if value is None:
        return unbounded
    if isinstance(value, str | bool):
        raise TypeError
    return float(value)


def read_initial(given, names, fixed):
    """{name: number} of all of some names; those fixed may be there, at their value."""
    if given is None:
        return None
    if not isinstance(given, Mapping | pd.Series):
        return dict(zip(names, read_numbers("initial", given, names).tolist(), strict=True))
    initial = _mapping("initial", given, "{'k': 2.0}")
    unknown = [name for name in initial if name not in names and name not in fixed]
    missing = [name for name in names if name not in initial]
    if unknown or missing:
        raise ValueError(
            f"initial must give every parameter and no other; missing {missing}, unknown "
            f"{unknown}, allowed {list(names)}"
        )
    initial = {name: _number(f"initial value of {name!r}", x) for name, x in initial.items()}
    for name in initial.keys() & fixed.keys():
        if initial[name] != fixed[name]:
            raise ValueError(
                f"initial gives {name!r} the value {initial[name]:g}, but it is fixed at "
                f"{fixed[name]:g}; leave it out of one of the two"
            )
    return {name: initial[name] for name in names}


def check_within(what, values, bounds):
    """Raise ValueError naming the parameter whose value its bounds exclude."""
    for name, value in values.items():
        low, high = bounds.get(name, (None, None))
        if (low is not None and value < low) or (high is not None and value > high):
            raise ValueError(
                f"the {what} value {value:g} of {name!r} is outside its bounds ({low}, {high}); "
                f"change one of them"
            )


def bound_array(bounds, names, end, unbounded):
    """One end of the bounds of some names, shape (k,), infinite where open."""
    ends = (bounds.get(name, (None, None))[end] for name in names)
    return np.array([unbounded if value is None else value for value in ends], dtype=float)


def describe(names, fixed, initial=None, bounds=None):
    """A line for each parameter of which something is known."""
    lines = []
    for name in names:
        if name in fixed:
            lines.append(f"{name} = {fixed[name]:.6g}, fixed")
            continue
        low, high = (bounds or {}).get(name, (None, None))
        left = "" if low is None else f"{low:.6g} <= "
        right = "" if high is None else f" <= {high:.6g}"
        start = f", initial {initial[name]:.6g}" if initial else ""
        if left or right or start:
            lines.append(f"{left}{name}{right}{start}")
    return lines


def check_known(what, given, names):
    """Raise ValueError if a name is no parameter."""
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(f"{what} names {unknown}, no parameters here; allowed are {list(names)}")


def read_numbers(what, values, names):
    """One finite float for each name, in their order."""
    try:
        numbers = np.asarray(values, dtype=float)
    except (TypeError, ValueError, OverflowError):
        numbers = None
    if numbers is None or numbers.shape != (len(names),) or not np.all(np.isfinite(numbers)):
        raise ValueError(
            f"{what} must hold {len(names)} finite numbers, one for each of {list(names)}; got "
            f"{values!r}"
        )
    return numbers


def _mapping(what, given, example):
    if given is None:
        return {}
    if not isinstance(given, Mapping | pd.Series):
        raise ValueError(f"{what}={given!r} is no mapping by name; give one such as {example}")
    if isinstance(given, pd.Series) and not given.index.is_unique:
        twice = list(given.index[given.index.duplicated()].unique())
        raise ValueError(f"{what} names {twice} more than once; give every name one value")
    return dict(given)


def _number(what, value):
    number = None if isinstance(value, bool) else finite_number(value)
    if number is None:
        raise ValueError(f"the {what} must be a finite number; got {value!r}")
    return number
