"""The open box behind a drawer's front."""

from aomgen.assets.shapes import AlignedBox, box


def tray_boxes(
    sides: tuple[float, float], depth: tuple[float, float], heights: tuple[float, float], thin: float
) -> dict[str, AlignedBox]:
    """Floor, two sides and back, by the name of their colliders.

    Args:
        sides: Outer planes across, asset frame x, [m].
        depth: From the front's back side to the tray's end, asset frame y, [m].
        heights: Of the floor's lower side and of the rim, [m].
        thin: Thickness of all four, [m].
    """
    (x0, x1), (start, end), (floor, rim) = sides, depth, heights
    return {
        "tray_bottom": box(x0, x1, start, end, floor, floor + thin, "y"),
        "tray_left": box(x0, x0 + thin, start, end, floor + thin, rim, "yz"),
        "tray_right": box(x1 - thin, x1, start, end, floor + thin, rim, "yz"),
        "tray_back": box(x0 + thin, x1 - thin, end - thin, end, floor + thin, rim, "xXz"),
    }
