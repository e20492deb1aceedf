"""What all frozen values share: arrays that cannot be changed after construction."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def require_indices(indices: NDArray[np.integer], count: int) -> None:
    """Refuse indices outside 0..count - 1.

    Raises:
        ValueError: One is.
    """
    if len(indices) and not (indices.min() >= 0 and indices.max() < count):
        raise ValueError(f"an index is outside 0..{count - 1}")


def freeze(value: Any, name: str, array: Any, shape: tuple[int | None, ...], dtype: Any = np.float64) -> None:
    """Store `array` on a frozen dataclass as a read-only, C-contiguous array.

    Args:
        value: The dataclass under construction (called from `__post_init__`).
        name: Field to set.
        array: Anything numpy understands.
        shape: Expected shape; None where any length will do.
        dtype: Element type.

    Raises:
        ValueError: The shape differs; a programming error, so not an `AomgenError`.
    """
    result = np.array(array, dtype=dtype, order="C")
    fits = result.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, result.shape, strict=True)
    )
    if not fits:
        raise ValueError(f"{type(value).__name__}.{name} has shape {result.shape}, want {shape}")
    result.flags.writeable = False
    object.__setattr__(value, name, result)
