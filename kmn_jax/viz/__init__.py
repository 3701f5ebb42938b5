"""Results to look at: a picture, and a page in the browser."""

from kmn_jax.viz._folder import one_after_the_other
from kmn_jax.viz._legend import draw_part
from kmn_jax.viz._mesh import PartMesh, part_mesh
from kmn_jax.viz._picture import check_drawing, check_picture, save_picture
from kmn_jax.viz._shading import distinct_colors
from kmn_jax.viz._truth import TRUTH_COLORS, truth_codes
from kmn_jax.viz._viewer import Viewer
from kmn_jax.viz._viewer_server import check_page

__all__ = [
    "TRUTH_COLORS",
    "PartMesh",
    "Viewer",
    "check_drawing",
    "check_page",
    "check_picture",
    "distinct_colors",
    "draw_part",
    "one_after_the_other",
    "part_mesh",
    "save_picture",
    "truth_codes",
]
