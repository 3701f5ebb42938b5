# mypy: disable-error-code="import-not-found"
"""Seven machine parts written as binary STL files in millimetres: the industrial set, unlike any training object.

    pip install build123d==0.13.0 bd_warehouse==0.4.0
    python -m experiments.write_industrial experiments/assets/industrial

Needs an environment of its own with these two libraries; neither kmn_jax nor anything it depends on has to be there.
Every length below is in millimetres. The axis of what turns is z, but for the bearing housing, which stands on the
plane z = 0 and has its axis along y. The same versions write the same bytes.
"""

from __future__ import annotations

import argparse
import struct
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from build123d import Part, Shape

# As a fraction of the bounding box's diagonal, and in radians between neighbouring triangles on a curve. Together they
# keep every triangle within 0.1% of the diagonal of the true surface. The thread's turns allow no more in 300 KB.
_TOLERANCE = 0.0005
_ANGLE = 0.25
_THREAD_ANGLE = 0.36


def gear_motor() -> Part:
    """Build a motor can on a spur gearbox, whose D-cut shaft leaves off-centre between six mounting holes."""
    import build123d as bd

    shaft_x = 6.5
    front = bd.Pos(0, 0, -10) * bd.Cylinder(18, 20)
    front = bd.chamfer(front.edges().group_by(bd.Axis.Z)[-1], 0.8)
    can = bd.Pos(0, 0, -36) * bd.Cylinder(16, 32)
    can = bd.fillet(can.edges().group_by(bd.Axis.Z)[0], 2.5)
    part = front + can + bd.Pos(0, 0, -22) * bd.Cylinder(17, 4)
    part += bd.Pos(0, 0, -53.5) * bd.Cylinder(5, 3) + bd.Pos(0, 0, -56) * bd.Cylinder(1.5, 2)
    part += bd.Pos(shaft_x, 0, 2.5) * bd.Cylinder(6, 5)

    shaft = bd.Pos(shaft_x, 0, 10) * bd.Cylinder(3, 20)
    shaft = bd.chamfer(shaft.edges().group_by(bd.Axis.Z)[-1], 0.5)
    part += shaft - bd.Pos(shaft_x + 2.4 + 5, 0, 14) * bd.Box(10, 10, 12)

    part -= bd.PolarLocations(14.5, 6, start_angle=30) * (bd.Pos(0, 0, -2) * bd.Cylinder(1.5, 4))
    for side in (-1, 1):
        part -= bd.Pos(side * 16, 0, -44) * bd.Box(3, 9, 5)
        terminal = bd.Box(3, 0.8, 8) - bd.Pos(0, 0, -2) * bd.Rot(90, 0, 0) * bd.Cylinder(0.7, 2)
        part += bd.Pos(0, side * 10, -55) * terminal
    return part


def timing_pulley() -> Part:
    """Build a 20-tooth pulley for a 3 mm round-tooth belt, with two flanges and a hub with two set-screw holes."""
    import build123d as bd

    teeth, width, outer = 20, 9.0, 9.17
    blank = bd.Circle(outer) - bd.PolarLocations(outer - 0.35, teeth) * bd.Circle(0.9)
    part = bd.Pos(0, 0, 1.5) * bd.extrude(blank, width)
    for z, turned in ((0, 180), (width + 3, 0)):
        profile = bd.Polyline((0, 0), (11.5, 0), (11.5, -0.6), (9.6, -1.5), (0, -1.5), close=True)
        flange = bd.revolve(bd.Plane.XZ * bd.make_face(profile), bd.Axis.Z)
        part += bd.Pos(0, 0, z) * bd.Rot(turned, 0, 0) * flange
    top = width + 3 + 8
    hub = bd.Pos(0, 0, top - 4) * bd.Cylinder(7.5, 8)
    part += bd.chamfer(hub.edges().group_by(bd.Axis.Z)[-1], 0.6)
    part -= bd.Pos(0, 0, top / 2) * bd.Cylinder(2.5, top)
    part = bd.chamfer(part.edges().filter_by(bd.GeomType.CIRCLE).filter_by(lambda edge: edge.radius == 2.5), 0.4)
    for turn in (0, 90):
        part -= bd.Pos(0, 0, top - 4) * bd.Rot(0, 0, turn) * bd.Rot(0, 90, 0) * bd.Pos(0, 0, 6) * bd.Cylinder(1.65, 8)
    return part


def belt_pulley() -> Part:
    """Build a spoked pulley for a 4 mm round belt, with a hub that stands out on one side only."""
    import build123d as bd

    rim, spokes = 22.0, 5
    half = bd.Polyline((4, -5), (9, -5), (9, -3), (17.5, -3), (17.5, -5), (rim, -5), (rim, -2.6), (18.6, -1.4))
    half += bd.ThreePointArc((18.6, -1.4), (17.9, 0), (18.6, 1.4))
    half += bd.Polyline((18.6, 1.4), (rim, 2.6), (rim, 5), (17.5, 5), (17.5, 3), (8, 3), (7.5, 12), (4, 12), (4, -5))
    part = bd.revolve(bd.Plane.XZ * bd.make_face(half), bd.Axis.Z)
    windows = bd.Circle(16) - bd.Circle(10) - bd.PolarLocations(13, spokes) * bd.Rectangle(10, 5)
    part -= bd.Pos(0, 0, -10) * bd.extrude(bd.fillet(windows.vertices(), 1), 20)
    part -= bd.Pos(0, 0, 8) * bd.Rot(0, 0, 36) * bd.Rot(0, 90, 0) * bd.Pos(0, 0, 6) * bd.Cylinder(1.65, 8)
    return part


def idler() -> Part:
    """Build a flanged roller on a ball bearing, which a retaining ring with a gap holds in from the top."""
    import build123d as bd

    roller = [(4, -8.2), (6, -8.2), (6, -6), (9.5, -6), (9.5, -7), (16, -7), (16, -6), (14.4, -5), (13, -5), (13, 5)]
    roller += [(14.4, 5), (16, 6), (16, 7), (11.5, 7), (11.5, 4), (10.3, 4), (10.3, 3.4), (6, 3.4), (6, 4.6), (4, 4.6)]
    part = bd.revolve(bd.Plane.XZ * bd.make_face(bd.Polyline(*roller, close=True)), bd.Axis.Z)
    ring = bd.Circle(11.5) - bd.Circle(9.6) - bd.Pos(12, 0) * bd.Rectangle(14, 8)
    for side in (-1, 1):
        ring += bd.Pos(8.7, side * 5.2) * bd.Circle(1.9) - bd.Pos(8.7, side * 5.2) * bd.Circle(0.8)
    return part + bd.Pos(0, 0, 3.4) * bd.extrude(ring, 2)


def bearing_housing() -> Part:
    """Build a pillow block: a foot with two slots, an insert bearing with a set-screw collar, a lubrication boss."""
    import build123d as bd

    height, turned = 27.0, bd.Rot(90, 0, 0)
    foot = bd.Pos(0, 0, 4.5) * bd.Box(76, 20, 9)
    foot = bd.fillet(foot.edges().filter_by(bd.Axis.Z), 5)
    body = bd.Pos(0, 0, height) * turned * bd.Cylinder(19.5, 18)
    web = bd.Polyline((-25, 8), (25, 8), (18, height), (-18, height), close=True)
    body += bd.Pos(0, 7, 0) * bd.extrude(bd.Plane.XZ * bd.make_face(web), 14)
    boss = bd.Pos(0, 0, height + 19.5) * bd.Cylinder(3.5, 6) - bd.Pos(0, 0, height + 20.5) * bd.Cylinder(1.5, 4)
    part = foot + body + boss
    for side in (-1, 1):
        slot = bd.Pos(side * 30, 0, 0) * bd.SlotCenterToCenter(4, 6.6)
        part -= bd.extrude(slot, 9)
        part -= bd.Pos(side * 30, 0, 8) * bd.extrude(bd.SlotCenterToCenter(4, 11), 1)

    axis = bd.Pos(0, 0, height) * turned
    for side in (-1, 1):
        seal = bd.Cylinder(14, 3) - bd.Cylinder(12.5, 3) + bd.Cylinder(12.5, 5) - bd.Cylinder(9.5, 5)
        part -= axis * bd.Pos(0, 0, side * 9) * seal
    collar = bd.Pos(0, 0, -2.5) * bd.Cylinder(9.5, 29)
    collar = bd.chamfer(collar.edges(), 0.8)
    part += axis * collar
    part -= axis * bd.Cylinder(6, 60)
    for turn in (60, 180):
        part -= axis * bd.Pos(0, 0, -14) * bd.Rot(0, 0, turn) * bd.Rot(0, 90, 0) * bd.Pos(0, 0, 8) * bd.Cylinder(1.5, 8)
    return part


def shaft() -> Part:
    """Build a stepped shaft with a collar, a keyway, a drilled end, a retaining-ring groove and a flat."""
    import build123d as bd

    outline = [(0, 0), (3.5, 0), (4, 0.5), (4, 2), (3.2, 2), (3.2, 3.1), (4, 3.1), (4, 20), (5, 20.5), (5, 44), (7, 44)]
    outline += [(7, 50), (5, 50), (5, 79.3), (4.3, 80), (2.1, 80), (1.65, 79.5), (1.65, 70), (0, 69)]
    part = bd.revolve(bd.Plane.XZ * bd.make_face(bd.Polyline(*outline, close=True)), bd.Axis.Z)
    keyway = bd.Plane.YZ * bd.Pos(0, 66) * bd.Rot(0, 0, 90) * bd.SlotOverall(18, 3)
    part -= bd.Pos(3.2, 0, 0) * bd.extrude(keyway, 5)
    return part - bd.Pos(-4 - 3.3, 0, 11) * bd.Box(8, 10, 10)


def screw() -> Part:
    """Build an ISO 4762 socket head cap screw, M12 x 20, with its helical thread fused to the core."""
    from bd_warehouse.fastener import SocketHeadCapScrew

    pieces = SocketHeadCapScrew(size="M12-1.75", length=20, fastener_type="iso4762", simple=False).solids()
    core = max(pieces, key=lambda piece: piece.volume)
    return core.fuse(*(piece for piece in pieces if piece is not core))


PARTS: dict[str, Callable[[], Part]] = {
    build.__name__: build for build in (gear_motor, timing_pulley, belt_pulley, idler, bearing_housing, shaft, screw)
}


def triangle_mesh(shape: Shape, angle: float = _ANGLE) -> tuple[np.ndarray, np.ndarray]:
    """Return the welded vertices (v, 3) float32 and outward triangles (t, 3) of a solid, in an order of their own.

    Raises:
        ValueError: the solid is not one closed surface after tessellation.
    """
    points, faces = shape.tessellate(_TOLERANCE * shape.bounding_box().diagonal, angle)
    vertices, welded = np.unique(np.asarray([tuple(p) for p in points], np.float32), axis=0, return_inverse=True)
    triangles = welded.reshape(-1)[np.asarray(faces)]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    # Sorted, so that the bytes do not depend on the order in which the kernel visits the faces.
    first = triangles.argmin(axis=1)[:, None]
    triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
    triangles = triangles[np.lexsort(triangles.T[::-1])]

    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    forward, backward = {tuple(e) for e in edges.tolist()}, {tuple(e) for e in edges[:, ::-1].tolist()}
    if len(shape.solids()) != 1 or len(forward) != len(edges) or forward != backward:
        raise ValueError(f"{len(shape.solids())} solids, {len(forward ^ backward)} open edges: not one closed surface")
    return vertices, triangles


def stl_bytes(name: str, vertices: np.ndarray, triangles: np.ndarray) -> bytes:
    """Return a binary STL file whose header holds the part's name and the unit."""
    corners = vertices[triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    records = np.zeros(len(triangles), np.dtype([("floats", "<f4", (4, 3)), ("attribute", "<u2")]))
    records["floats"] = np.concatenate([normals[:, None], corners], axis=1)
    header = f"kmn_jax industrial set, {name}, millimetres".encode().ljust(80)
    return header + struct.pack("<I", len(triangles)) + records.tobytes()


def main(folder: Path) -> None:
    """Write the files into `folder` and print their sizes."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, build in PARTS.items():
        vertices, triangles = triangle_mesh(build(), _THREAD_ANGLE if build is screw else _ANGLE)
        content = stl_bytes(name, vertices, triangles)
        (folder / f"{name}.stl").write_bytes(content)
        extent = " x ".join(f"{length:.2f}" for length in np.ptp(vertices, axis=0))
        print(f"{name}: {extent} mm, {len(triangles)} triangles, {len(content) / 1000:.0f} KB", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Write the industrial set as STL files.")
    parser.add_argument("folder", type=Path)
    main(parser.parse_args().folder)
