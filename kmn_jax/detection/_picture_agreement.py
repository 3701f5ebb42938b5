"""The picture of an object at a pose against the measured surface: does the surface lie, turn and end as it should?

A flat part agrees with every floor, wall and rim in depth and normals. What tells them apart is the outline, where a
larger surface goes on in its own plane, and how much of the surface there is to agree with. So both are compared in
cells of a grid over the object's picture, each with a depth and a normal as predicted and as measured.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from kmn_jax.detection._cells import fit_plane, grown, most, places_of, summed
from kmn_jax.detection._depth_agreement import DepthImage
from kmn_jax.detection._picture_cells import LOOSE, PICTURE_SIDE, Measured, Predicted, measured, predicted
from kmn_jax.simulate import Surfels
from kmn_jax.typing import Pose, Scalar

# Lengths are in diameters of the object, normals are compared by their cosines.
_TIGHT, _NEAR = 0.01, 0.02  # between depths
_LEVEL = 0.03  # the same, across the outline, where the surface may bend
_ALIKE, _TURNED = 0.85, 0.5
_PLANE, _PLANE_ALIKE = 0.015, 0.9  # of what lies in one plane
_REACH = 3  # cells over which a plane is fitted
_BELOW, _RAISED = 0.02, 0.5  # the plane around an object: so far below it is all below, so high at most counts
_NO_RELIEF = 1e-3  # diameters: with less, a surface is as good as flat
_UNSURE = 0.002  # diameters, of depths, whatever the sensor: what odds of a relief are measured by
_NARROW, _WIDE = 1, 3  # cells: the reach of windows, 3 and 7 cells wide


class PictureAgreement(NamedTuple):
    """Shares of the cells of an object's picture, then of its outline; the outline is what is two cells away from it.

    Holes have an outline, too. Cells of the picture outside of the image count as not measured, those of the outline
    are left out. A piece that is not there, such as the handle of a mug, is few cells of the picture: so those that are
    seen through are also counted in the square window that has most of them, as shares of all of its cells, of which
    some may lie beyond the picture.
    """

    tight: Scalar  # measured within 1% of the diameter
    near: Scalar  # within 2%
    behind: Scalar  # seen through: farther than the surface by more than 1%
    behind_in_3: Scalar  # the same of the 3 by 3 cells where it is most
    behind_in_7: Scalar  # of 7 by 7 cells
    aligned: Scalar  # of what is measured about where it should be: the normal is as it should be
    turned: Scalar  # of the same: the normal is quite another
    with_normal: Scalar  # measured densely enough for a normal
    variety: Scalar  # of the predicted normals: 0 for a plane, towards 1 for a ball
    confirmed_variety: Scalar  # the same of those that are confirmed
    deviation: Scalar  # root mean square of the differences in depth where they are small, in diameters
    offset: Scalar  # their mean
    noise: Scalar  # of depths within a cell, in diameters
    log_cells: Scalar
    log_area: Scalar  # of what is measured within 2%, in the square of the diameter
    relief: Scalar  # where differences in depth are small: how far the object's surface departs from its plane
    relief_alike: Scalar  # its correlation with what is measured, towards 0 where one of them is flat; -1 to 1
    relief_missed: Scalar  # how far the two are apart
    relief_odds: Scalar  # log odds that this relief was measured, not a plane with noise; log(1 + |.|), with their sign
    relief_slope: Scalar  # by how much what is measured departs where the object's surface does by 1, ...
    relief_slope_error: Scalar  # ... and the standard error of that
    log_pixel: Scalar  # of the width of a pixel on the object, in diameters
    open: Scalar  # something farther away was measured, or nothing, as where the background is cut away
    stepped: Scalar  # something farther away by 1% of the diameter was measured
    level: Scalar  # the measured surface goes on
    fronted: Scalar  # something in front was measured
    coplanar: Scalar  # the measured surface goes on in one plane
    buried: Scalar  # of the whole surface: below the plane of what surrounds it; by less than 2% it counts in part
    raised: Scalar  # mean height of that surface above the plane, seen from the camera, at most half a diameter
    surrounded: Scalar  # of the whole surface: inside of what is measured around it, see `_beside_outline`
    buried_between: Scalar  # buried, where each point of the surface counts as much as it is surrounded
    beside: Scalar  # what surrounds it: measured, and not in front
    uneven: Scalar  # root mean square of how far that is off its plane, in depth and diameters, each by 0.5 at most
    buried_deep: Scalar  # buried by more than what surrounds it is uneven; by less than 2% more it counts in part


def picture_agreement(T_camera_object: Pose, surfels: Surfels, image: DepthImage, diameter: Scalar) -> PictureAgreement:
    """Compare an object at a pose with a depth image in the same unit, zero where nothing was measured.

    All is zero of a pose that shows nothing to the camera, but `log_area`, which is then the least, and
    `relief_slope_error`, which is 1.
    """
    seen = predicted(T_camera_object, surfels, image)
    found = measured(seen, image, diameter)
    mask, there = seen.mask, found.there
    away = found.away / diameter
    gap = jnp.where(there, found.depth - seen.depth, 0) / diameter

    def share(which: Bool[Array, "s s"], of: Bool[Array, "s s"] = mask) -> Scalar:
        return (of & which).sum(dtype=jnp.float32) / jnp.maximum(of.sum(dtype=jnp.float32), 1)

    def mean(values: Float[Array, "s s"], of: Bool[Array, "s s"]) -> Scalar:
        return jnp.where(of, values, 0).sum() / jnp.maximum(of.sum(dtype=jnp.float32), 1)

    def variety(of: Bool[Array, "s s"]) -> Scalar:
        total = jnp.where(of[..., None], seen.normals, 0).sum(axis=(0, 1))
        return jnp.where(of.any(), 1 - jnp.sqrt((total**2).sum()) / jnp.maximum(of.sum(dtype=jnp.float32), 1), 0)

    tight, near, loose = (mask & there & (away < limit) for limit in (_TIGHT, _NEAR, LOOSE))
    cosine = (seen.normals * found.normals).sum(axis=-1)
    compared = loose & found.has_normal
    small = loose & (jnp.abs(gap) < LOOSE)
    behind = mask & there & (gap > _TIGHT) & ~tight
    return PictureAgreement(
        tight=share(tight),
        near=share(near),
        behind=share(behind),
        behind_in_3=_densest(behind, _NARROW),
        behind_in_7=_densest(behind, _WIDE),
        aligned=share(cosine > _ALIKE, compared),
        turned=share(cosine < _TURNED, compared),
        with_normal=share(found.has_normal),
        variety=variety(mask),
        confirmed_variety=variety(compared & (cosine > _ALIKE)),
        deviation=jnp.sqrt(mean(gap**2, small)),
        offset=mean(gap, small),
        noise=mean(found.noise, small) / diameter,
        log_cells=jnp.log1p(mask.sum(dtype=jnp.float32)),
        log_area=jnp.log(near.sum(dtype=jnp.float32) * (seen.pitch * seen.nearest / diameter) ** 2 + 1e-4),
        log_pixel=jnp.where(mask.any(), jnp.log(seen.nearest / (image.camera.fx * diameter)), 0),
        **_relief(seen, found, small, diameter),
        **_outline(seen, found, compared, diameter),
    )


def _densest(cells: Bool[Array, "s s"], reach: int) -> Scalar:
    """Return the share of a square window that such cells are, in the one that has most of them."""
    return summed(cells.astype(jnp.float32)[..., None], reach).max() / (2 * reach + 1) ** 2


def _beside_outline(
    seen: Predicted, found: Measured, around: Bool[Array, "s s"], diameter: Scalar
) -> dict[str, Scalar]:
    """Return how an object's whole surface lies to the plane of what is measured around it; in it if nothing is.

    Where cells all lie to one side, the plane beyond them is anybody's guess. So each point is surrounded in full up to
    one standard deviation of the cells from their middle, and farther away, at d of these, by 1 / d^2: by a half on a
    ring of cells. Among the uneven neighbours of a pile the plane says little, too.
    """
    plane, some = fit_plane(found.depth, around, seen.nearest), around.any()
    z = jnp.maximum(seen.surface[:, 2], 1e-6 * diameter)
    x, y = ((seen.surface[:, axis] / z - first[0, 0]) / seen.pitch for axis, first in ((0, seen.u), (1, seen.v)))
    height = jnp.where(some, (plane.depth(x, y) - z) / diameter, 0)
    off = jnp.clip((plane.depth(*places_of(found.depth)) - found.depth) / diameter, -_RAISED, _RAISED)
    uneven = jnp.sqrt(jnp.where(around, off**2, 0).sum() / jnp.maximum(around.sum(dtype=jnp.float32), 1))
    below = jnp.clip(-height / _BELOW, 0, 1)
    between = jnp.where(some, 1 / jnp.maximum(plane.closeness.away(x, y), 1), 0)
    return {
        "buried": below.mean(),
        "raised": jnp.clip(height, -_RAISED, _RAISED).mean(),
        "surrounded": between.mean(),
        "buried_between": (between * below).mean(),
        "uneven": uneven,
        "buried_deep": jnp.clip((-height - uneven) / _BELOW, 0, 1).mean(),
    }


def _relief(seen: Predicted, found: Measured, of: Bool[Array, "s s"], diameter: Scalar) -> dict[str, Scalar]:
    """Return how an object's surface departs from its plane in some cells, and whether what is measured does."""

    def departing(depth: Float[Array, "s s"]) -> Float[Array, "s s"]:
        plane = fit_plane(depth, of, seen.nearest)
        return jnp.where(of, depth - plane.depth(*places_of(depth)), 0) / diameter

    def mean(values: Float[Array, "s s"]) -> Scalar:
        return values.sum() / count

    count = jnp.maximum(of.sum(dtype=jnp.float32), 1)
    own, other = departing(seen.depth), departing(found.depth)
    of_own, of_other, both, missed = (mean(of) for of in (own**2, other**2, own * other, (own - other) ** 2))
    sizes = [jnp.sqrt(jnp.maximum(square, _NO_RELIEF**2)) for square in (of_own, of_other)]
    odds = count / 2 * jnp.log((of_other + _UNSURE**2) / (missed + _UNSURE**2))
    return {
        "relief": jnp.sqrt(of_own),
        "relief_alike": both / (sizes[0] * sizes[1]),
        "relief_missed": jnp.sqrt(missed),
        "relief_odds": jnp.sign(odds) * jnp.log1p(jnp.abs(odds)),
        "relief_slope": both / (of_own + (3 * _NO_RELIEF) ** 2),
        "relief_slope_error": jnp.sqrt((missed + _NO_RELIEF**2) / (of_own + _NO_RELIEF**2) / count),
    }


def _outline(seen: Predicted, found: Measured, compared: Bool[Array, "s s"], diameter: Scalar) -> dict[str, Scalar]:
    """Return how the measured surface goes on beyond the outline, and how the object's lies to it."""
    edge = grown(seen.mask)
    outline = grown(edge) & ~edge & found.in_image
    # Of cells without depth, the farthest of those around, twice.
    depth = jnp.where(seen.mask, seen.depth, -jnp.inf)
    for _ in range(2):
        depth = jnp.where(jnp.isfinite(depth), depth, most(depth))
    gap = jnp.where(outline & found.there, found.depth - depth, 0) / diameter
    there = outline & found.there
    fronted = there & (gap < -_LEVEL)
    level = there & (jnp.abs(gap) <= _LEVEL)
    # The plane of what is measured on the object near by.
    count, normal, center = (
        summed(jnp.where(compared[..., None], values, 0), _REACH)
        for values in (jnp.ones((PICTURE_SIDE, PICTURE_SIDE, 1), jnp.float32), found.normals, found.points)
    )
    normal = normal / jnp.sqrt(jnp.maximum((normal**2).sum(axis=-1, keepdims=True), 1e-24))
    height = ((found.points - center / jnp.maximum(count, 1)) * normal).sum(axis=-1) / diameter
    parallel = (found.normals * normal).sum(axis=-1) > _PLANE_ALIKE
    coplanar = there & (count[..., 0] > 0) & (jnp.abs(height) < _PLANE) & found.has_normal & parallel

    def share(which: Bool[Array, "s s"], of: Bool[Array, "s s"] = outline) -> Scalar:
        return (of & which).sum(dtype=jnp.float32) / jnp.maximum(of.sum(dtype=jnp.float32), 1)

    return {
        "open": share(~found.there | (gap > _LEVEL)),
        "stepped": share(there & (gap > _TIGHT)),
        "level": share(level),
        "fronted": share(fronted),
        "coplanar": share(coplanar),
        "beside": share(there & ~fronted),
        **_beside_outline(seen, found, there & ~fronted, diameter),
    }
