"""Right units pass with room, wrong ones are named with the factor, and measured sizes are those of the scan."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from kmn_jax.errors import InputError
from kmn_jax.io import (
    DepthCamera,
    Scan,
    camera_question,
    depth_scan,
    length_doubt,
    length_problem,
    object_doubt,
    resolve_unit,
    scene_size,
    size_question,
    stated_unit,
)
from kmn_jax.io._scale import SceneSize
from kmn_jax.units import METRES

# In mm: the object's diameter; the scene's extent, spacing and distance.
MOTOR = (60.0, 500.0, 0.6, 700.0)  # in a bin of 400 x 300
RIGHT = {
    "motor": MOTOR,
    "cloud": (60.0, 500.0, 0.6, None),
    "small": (3.0, 180.0, 0.25, 500.0),  # 3 mm in a bin of 150 x 100
    "coarse": (3.0, 180.0, 0.5, 500.0),
    "cropped": (60.0, 55.0, 0.6, 700.0),
    "half": (60.0, 30.0, 0.6, None),
    "large": (500.0, 1500.0, 2.0, 1800.0),
    "hall": (2000.0, 20_000.0, 10.0, 8000.0),
    "near": (40.0, 60.0, 0.05, 100.0),
}


def in_unit(value: float, unit: str) -> float:
    return value * METRES["mm"] / METRES[unit]


def scene(sizes: tuple[float, float, float, float | None], true: str, read_as: str | None = None) -> SceneSize:
    """Return a scene whose file is in the unit `true`, and is read as another one."""
    _, extent, spacing, distance = sizes
    far = None if distance is None else in_unit(distance, true)
    return SceneSize(in_unit(extent, true), in_unit(spacing, true), far, read_as or true)


@pytest.mark.parametrize("name", RIGHT)
def test_right_units_pass_with_room(name: str) -> None:
    diameter, extent, spacing, distance = RIGHT[name]
    for object_unit, scene_unit, room in product(METRES, METRES, (0.85, 1, 1.15)):
        sizes = (diameter, extent * room, spacing * room, None if distance is None else distance * room)
        assert length_problem(in_unit(diameter, object_unit), object_unit, scene(sizes, scene_unit)) is None


@pytest.mark.parametrize("name", RIGHT)
def test_millimetres_and_metres_are_never_taken_for_each_other(name: str) -> None:
    for true, wrong, change in (("m", "mm", "1000 times larger"), ("mm", "m", "1000 times smaller")):
        found = length_problem(RIGHT[name][0], "mm", scene(RIGHT[name], true, wrong))
        assert found is not None
        assert f"the scene would fit {change}" in found
        assert found.endswith(f"say --units {true}")
        assert "\n" not in found


@pytest.mark.parametrize("name", ["motor", "cloud", "cropped", "large"])
def test_an_object_in_metres_read_as_millimetres(name: str) -> None:
    found = length_problem(in_unit(RIGHT[name][0], "m"), "mm", scene(RIGHT[name], "mm"))
    assert found is not None
    assert "the object would fit 1000 times larger, so its lengths are probably metres" in found
    assert "say --object-units m (a card is made again by kmn prepare --units m, a GLB or STEP file" in found


def test_the_sentence_as_a_whole() -> None:
    assert length_problem(60.0, "mm", scene(MOTOR, "m", "mm")) == (
        "the object of 60 mm is larger than the scene of 0.5 mm: the scene would fit 1000 times larger, so its"
        " lengths are probably metres: say --units m"
    )
    assert length_problem(60 / 25.4, "mm", scene(MOTOR, "mm")) == (
        "the object of 2.36 mm is far too small for the scene of 500 mm: the object would fit 25.4 times larger, so its"
        " lengths are probably inches (centimetres for the object would fit, too): say --object-units in (a card is"
        " made again by kmn prepare --units in, a GLB or STEP file is to be exported again); if the image's depth is"
        " stored in other steps than mm, give depth_scale in the camera file"
    )
    cloud = replace(scene(MOTOR, "mm"), distance=None)
    told = length_problem(60 / 25.4, "mm", cloud)
    assert told is not None
    assert told.endswith("is to be exported again)")


def test_a_more_usual_unit_is_told_where_nothing_is_found() -> None:
    assert length_doubt(60.0, "mm", scene(MOTOR, "mm")) is None
    tenth = scene(MOTOR, "cm", "mm")
    assert length_problem(60.0, "mm", tenth) is None
    told = "if the scan's lengths are inches or centimetres, not millimetres, say --units in or cm"
    assert length_doubt(60.0, "mm", tenth) == told


@pytest.mark.parametrize("name", RIGHT)
def test_centimetres_read_as_millimetres_are_told(name: str) -> None:
    shown = scene(RIGHT[name], "cm", "mm")
    told = length_problem(RIGHT[name][0], "mm", shown) or length_doubt(RIGHT[name][0], "mm", shown)
    assert told is not None
    assert "centimetres" in told


@pytest.mark.parametrize("name", RIGHT)
def test_an_object_in_inches_read_as_millimetres_is_told_and_one_in_millimetres_is_not(name: str) -> None:
    (diameter, *_), shown = RIGHT[name], scene(RIGHT[name], "mm")
    read = in_unit(diameter, "in")
    told = length_problem(read, "mm", shown) or object_doubt(read, shown, scene_follows=False)
    assert told is not None
    assert "--object-units" in told
    if name not in ("small", "coarse"):  # 3 mm in a bin, where 3 inches are more usual
        assert "inches" in told
        assert object_doubt(diameter, shown, scene_follows=False) is None


def test_the_doubt_about_an_object_as_a_whole() -> None:
    shown = scene(MOTOR, "mm")
    said = (
        "the object's unit was taken to be mm, so that its diameter is 3 mm: if its numbers are inches or centimetres,"
        " say --object-units in or cm (in Python unit=, for a card kmn prepare --units)"
    )
    assert object_doubt(3.0, shown, scene_follows=False) == said
    assert object_doubt(3.0, shown, scene_follows=True) == f"{said}, and --units mm for the scan"
    in_metres = scene(MOTOR, "m")
    assert object_doubt(3.0, in_metres, scene_follows=False) == said


@pytest.mark.parametrize(
    ("true", "wrong", "change"),
    [
        ("m", "cm", "100 times larger"),
        ("m", "in", "39.37 times larger"),
        ("in", "mm", "25.4 times larger"),
        ("in", "m", "39.37 times smaller"),
        ("mm", "in", "25.4 times smaller"),
    ],
)
def test_other_units_of_a_usual_scene(true: str, wrong: str, change: str) -> None:
    found = length_problem(60.0, "mm", scene(MOTOR, true, wrong))
    assert found is not None
    assert f"the scene would fit {change}" in found
    assert found.endswith(f"say --units {true}")


def test_alternatives_that_cannot_be_told_apart_are_named() -> None:
    found = length_problem(60.0, "mm", scene(MOTOR, "cm", "m"))
    assert found is not None
    assert "probably inches (centimetres for the scene" in found


@pytest.mark.parametrize(
    ("size", "message"),
    [
        (SceneSize(15.0, 0.1, None, "mm"), "is larger than the scene of 15 mm"),
        (SceneSize(13_000.0, 0.1, None, "mm"), "is far too small for the scene of 13000 mm"),
        (SceneSize(500.0, 25.0, None, "mm"), "too small for a scene whose points are 25 mm apart"),
        (SceneSize(100.0, 0.1, 15.0, "mm"), "too large for a scene 15 mm away"),
        (SceneSize(9000.0, 0.1, 31_000.0, "mm"), "too small for a scene 31000 mm away"),
    ],
)
def test_each_limit_is_named(size: SceneSize, message: str) -> None:
    found = length_problem(60.0, "mm", size)
    assert found is not None
    assert message in found


def test_where_no_unit_fits_none_is_suggested() -> None:
    found = length_problem(60.0, "mm", SceneSize(500.0, 400.0, None, "mm"))
    assert found is not None
    assert found.endswith("no other unit of m, cm, mm, in makes them fit: check that both are what they should be")


def test_bad_arguments_are_named() -> None:
    for diameter in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(InputError, match="must be above zero and finite"):
            length_problem(diameter, "mm", scene(MOTOR, "mm"))
    with pytest.raises(InputError, match="unit 'ft' is not known"):
        length_problem(1.0, "ft", scene(MOTOR, "mm"))


def test_units_are_resolved() -> None:
    assert resolve_unit("auto", "in") == "in"
    assert resolve_unit("auto", "in", stated="mm") == "mm"
    assert resolve_unit("m", "mm") == "m"
    assert resolve_unit("mm", "m", stated="mm") == "mm"
    with pytest.raises(InputError, match="cannot be m, as its format states mm: leave --units out"):
        resolve_unit("m", "mm", stated="mm")
    with pytest.raises(InputError, match="unit 'ft' is not known: use one of auto, m, cm, mm, in"):
        resolve_unit("ft", "mm")
    with pytest.raises(InputError, match="unit 'ft' is not known"):
        resolve_unit("auto", "ft")


def test_a_depth_image_is_measured() -> None:
    depth = np.full((48, 64), 700.0)
    depth[0, :3] = 4000  # strays
    size = scene_size(depth_scan(depth, DepthCamera(80.0, 80.0, 31.5, 23.5, 1.0, None), "mm"))
    assert size.unit == "mm"
    assert size.spacing == pytest.approx(700 / 80, rel=1e-3)
    assert size.distance == pytest.approx(740, rel=0.03)
    # The outermost percent on each side of a row of 64 and of a column of 48 is less than a pixel.
    assert size.extent == pytest.approx(np.hypot(63, 47) * 700 / 80, rel=0.02)


def test_clouds_are_measured_alike_however_large(monkeypatch: pytest.MonkeyPatch) -> None:
    grid = np.stack(np.meshgrid(np.arange(200), np.arange(150), [500]), axis=-1).reshape(-1, 3).astype(np.float32)
    whole = scene_size(Scan(grid, None, None, None, "mm"))
    assert whole == scene_size(Scan(grid, None, None, None, "mm"))
    assert whole.distance is None
    assert whole.spacing == 1
    assert whole.extent == pytest.approx(0.98 * np.hypot(199, 149), rel=0.01)
    monkeypatch.setattr("kmn_jax.io._scale._MOST", 3000)
    thinned = scene_size(Scan(grid, None, None, None, "mm"))
    assert thinned.extent == pytest.approx(whole.extent, rel=0.05)
    assert 0.3 < thinned.spacing < 1.1  # no grid any more, so that the nearest one is nearer
    one = scene_size(Scan(grid[:1], None, None, None, "mm"))
    assert (one.extent, one.spacing) == (0, 0)
    assert length_problem(60.0, "mm", one) is not None


def test_an_object_of_an_odd_size_brings_a_question() -> None:
    assert size_question(0.058, "mm", "--units {}") == (
        "is the object really 0.058 mm large? If its numbers are metres, say --units m, or make what states mm again"
    )
    assert size_question(60_000.0, "cm", "--object-units {}") == "is the object really 60000 cm large?"
    for diameter, unit in ((58.0, "mm"), (0.058, "m"), (2.0, "in"), (0.6, "mm"), (4.0, "m")):
        assert size_question(diameter, unit, "--units {}") is None


@pytest.mark.parametrize(
    ("content", "unit"),
    [
        (b"#1=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));", "mm"),
        (b"#1=( LENGTH_UNIT() NAMED_UNIT(*) SI_UNIT( .CENTI. , .METRE. ) );", "cm"),
        (b"#1=(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT());#2=(SI_UNIT($,.METRE.));", "m"),
        (b"#1=(SI_UNIT(.MILLI.,.METRE.));#2=(CONVERSION_BASED_UNIT('INCH',#3)LENGTH_UNIT());", "in"),
        (b"nothing", "mm"),
    ],
)
def test_a_step_file_states_its_unit(content: bytes, unit: str, tmp_path: Path) -> None:
    (tmp_path / "part.STP").write_bytes(content)
    assert stated_unit(tmp_path / "part.STP") == unit


def test_other_files_state_metres_or_nothing(tmp_path: Path) -> None:
    assert stated_unit("part.glb") == "m"
    assert stated_unit("part.stl") is None
    with pytest.raises(InputError, match="cannot be read"):
        stated_unit(tmp_path / "none.step")


def test_a_camera_at_the_robot_s_base_is_asked_about() -> None:
    assert camera_question(0.8, "mm", 60.0) == (
        "the camera would be 0.8 mm from the robot's base: is T_base_camera in metres? Then give its lengths in mm, or"
        ' say "unit": "m" in its file'
    )
    far = camera_question(800.0, "m", 0.06)
    assert far is not None
    assert "800 m from the robot's base: is T_base_camera in millimetres?" in far
    for distance, unit in ((0.0, "mm"), (800.0, "mm"), (0.8, "m"), (7.0, "mm"), (0.01, "mm"), (1e6, "m")):
        assert camera_question(distance, unit, in_unit(60.0, unit)) is None
    assert camera_question(150.0, "mm", 2000.0) is None
