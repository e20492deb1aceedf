"""Checks of what callers pass to public functions."""

from collections.abc import Collection, Iterable

import numpy as np
from numpy.typing import ArrayLike

from aomgen.core.transforms import ROTATION_TOLERANCE, measure_rigidity
from aomgen.core.values import Array
from aomgen.errors import ConfigError, NonFiniteError, PoseError, ShapeError, UnknownNameError


def require_array(name: str, value: ArrayLike, shape: tuple[int | None, ...]) -> Array:
    """Return a finite float64 array; None in `shape` accepts any length of that axis.

    Raises:
        ConfigError: The value is not an array of numbers.
        ShapeError: The array has another shape.
        NonFiniteError: A number is NaN or infinite.
    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise ConfigError(name, f"is not an array of numbers ({error})", "pass numbers") from error
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("N" if length is None else str(length) for length in shape)
        raise ShapeError(name, array.shape, f"({wanted}{',' * (len(shape) == 1)})")
    if not np.isfinite(array).all():
        first = np.argwhere(~np.isfinite(array))[0].tolist()
        raise NonFiniteError(name, f"contains {array[tuple(first)]} at {first}", "pass finite numbers")
    return array


def require_poses(name: str, value: ArrayLike, *, single: bool = False) -> Array:
    """Return rigid poses (N, 4, 4), or one (4, 4).

    Raises:
        ShapeError, NonFiniteError: See `require_array`.
        PoseError: A matrix is not a rotation with a translation.
    """
    poses = require_array(name, value, (4, 4) if single else (None, 4, 4))
    for index, T in enumerate(poses.reshape(-1, 4, 4)):
        determinant, deviation = measure_rigidity(T)
        last_row_off = float(np.abs(T[3] - [0, 0, 0, 1]).max())
        if deviation > ROTATION_TOLERANCE or determinant < 0 or last_row_off > ROTATION_TOLERANCE:
            raise PoseError(name, index, determinant, max(deviation, last_row_off))
    return poses


def require_times(name: str, value: ArrayLike, count: int) -> Array:
    """Return strictly increasing times (count,), [s].

    Raises:
        ShapeError, NonFiniteError: See `require_array`.
        ConfigError: A time is not later than the one before it.
    """
    times = require_array(name, value, (count,))
    steps = np.diff(times)
    if (steps <= 0).any():
        index = int(np.argmax(steps <= 0)) + 1
        raise ConfigError(
            name, f"is {times[index]:g} s at index {index} after {times[index - 1]:g} s", "sort the samples"
        )
    return times


def require_name(where: str, name: str, known: Collection[str]) -> str:
    """Return the name.

    Raises:
        UnknownNameError: The name is not among the known ones.
    """
    if name not in known:
        raise UnknownNameError(where, name, known)
    return name


def require_count(name: str, value: int, least: int = 1) -> int:
    """Return a whole number that is at least `least`.

    Raises:
        ConfigError: The value is something else.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < least:
        raise ConfigError(name, f"is {value!r}", f"pass a whole number of at least {least}")
    return int(value)


def require_known_keys(where: str, names: Iterable[str], known: Collection[str]) -> None:
    """Refuse keyword arguments that do not exist.

    Raises:
        UnknownNameError: One of them is unknown.
    """
    for name in names:
        require_name(where, name, known)
