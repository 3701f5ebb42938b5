"""Results to look at: a picture, and a page in the browser."""

from kmn_jax.viz._legend import draw_part
from kmn_jax.viz._picture import check_picture, save_picture
from kmn_jax.viz._shading import distinct_colors
from kmn_jax.viz._truth import TRUTH_COLORS, truth_codes
from kmn_jax.viz._viewer import Viewer

__all__ = [
    "TRUTH_COLORS",
    "Viewer",
    "check_picture",
    "distinct_colors",
    "draw_part",
    "save_picture",
    "truth_codes",
]
