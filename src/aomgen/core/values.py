"""Read-only arrays with declared shapes, for the fields of frozen dataclasses.

A field declares its shape in its annotation: `points: Annotated[Array, "N 3"]`. A letter stands for the same length in all
fields of a value, `_` for any length.
"""

import types
from dataclasses import fields
from functools import cache
from typing import Annotated, Any, Union, get_args, get_origin

import numpy as np
from numpy.typing import NDArray

from aomgen.errors import ShapeError

Array = NDArray[np.float64]
Vector3 = Annotated[Array, "3"]
Matrix4 = Annotated[Array, "4 4"]


def require_indices(indices: NDArray[np.integer], count: int) -> None:
    """Check that all indices are in 0..count - 1.

    Raises:
        ValueError: An index is out of range.
    """
    if len(indices) and not (indices.min() >= 0 and indices.max() < count):
        raise ValueError(f"an index is outside 0..{count - 1}")


def freeze_arrays(value: Any) -> None:
    """Convert every array of a dataclass to the declared type, make it read-only and C-contiguous, and check its shape.

    Fields that hold other sequences may declare their length. Fields may also hold None. Dataclasses use this function as
    their `__post_init__`, or call it there.

    Raises:
        ShapeError: A shape differs from the declared one.
    """
    lengths: dict[str, int] = {}
    for name, dtype, wanted in _read_declared_arrays(type(value)):
        held = getattr(value, name)
        if held is None:
            continue
        shape = (len(held),)
        if dtype is not None:
            array = _frozen(held, dtype)
            object.__setattr__(value, name, array)
            shape = array.shape
        if not _fits(shape, wanted, lengths):
            raise ShapeError(f"{type(value).__name__}.{name}", shape, f"({' '.join(wanted)})")


@cache
def _read_declared_arrays(kind: type) -> list[tuple[str, Any, list[str]]]:
    """Read the name, element type (None if it is no array) and shape of every field that declares a shape."""
    found: list[tuple[str, Any, list[str]]] = []
    for field in fields(kind):
        optional = get_origin(field.type) in (Union, types.UnionType)
        for option in get_args(field.type) if optional else (field.type,):
            if get_origin(option) is Annotated:
                # NDArray[np.uint8] is ndarray[shape, dtype[np.uint8]].
                is_array = get_origin(option.__origin__) is np.ndarray
                dtype = get_args(get_args(option.__origin__)[1])[0] if is_array else None
                found.append((field.name, dtype, option.__metadata__[0].split()))
    return found


def _frozen(array: Any, dtype: Any) -> NDArray[Any]:
    frozen = np.asarray(array, dtype=dtype, order="C")
    # Read-only arrays need no copy; any other array could still be changed by its owner.
    if frozen.flags.writeable and (frozen is array or frozen.base is not None):
        frozen = frozen.copy()
    frozen.flags.writeable = False
    return frozen


def _fits(shape: tuple[int, ...], declared: list[str], lengths: dict[str, int]) -> bool:
    return len(shape) == len(declared) and all(
        want == "_" or have == (int(want) if want.isdigit() else lengths.setdefault(want, have))
        for have, want in zip(shape, declared, strict=True)
    )
