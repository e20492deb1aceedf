"""Colors of made furniture, sRGB 0..1."""

from typing import Final

# Oak, walnut, mahogany, maple.
WOODS: Final = ((0.76, 0.60, 0.42), (0.58, 0.40, 0.26), (0.42, 0.28, 0.20), (0.83, 0.74, 0.60))
# White, blue, green, red.
PAINTS: Final = ((0.86, 0.85, 0.82), (0.34, 0.45, 0.52), (0.52, 0.58, 0.44), (0.70, 0.34, 0.26))
# Stained wood and black lacquer.
DARKS: Final = ((0.13, 0.11, 0.10), (0.15, 0.16, 0.18), (0.21, 0.14, 0.10))
# Steel, brass, black.
METALS: Final = ((0.76, 0.76, 0.78), (0.72, 0.60, 0.36), (0.22, 0.22, 0.23))
