from __future__ import annotations

import json
import shutil
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from experiments import build_data, kicad, show_data, test_sets
from experiments.build_data import SMALL_PACK, reach_beyond_bin
from experiments.kicad import catalogue_sources
from kmn_jax.bop import BopDataset
from kmn_jax.data import Pack, PackConfig
from kmn_jax.errors import InputError
from kmn_jax.io import read_mesh
from kmn_jax.simulate import BinScene, CameraConfig, RayMesh, SensorConfig, render

ROOT = Path(__file__).parents[2]
ASSETS = test_sets.ASSETS


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", *arguments], cwd=ROOT, capture_output=True, text=True)


def test_takes_models_from_a_folder_with_families_mixed(tmp_path: Path) -> None:
    sources, licence = catalogue_sources(tmp_path, tmp_path / "unused", 60)
    assert len(sources) == 60
    assert len({source.name.split("/")[0] for source in sources}) > 20  # families
    assert all(source.path == tmp_path / f"{source.name}.step" for source in sources)
    assert "CC-BY-SA" in licence
    everything, _ = catalogue_sources(tmp_path, tmp_path / "unused", None)
    assert len({source.name for source in everything}) == 1507
    assert everything[:60] == sources
    assert not (tmp_path / "unused").exists()


def test_says_where_models_come_from_without_debian(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kicad.shutil, "which", lambda name: None)
    with pytest.raises(InputError, match=r"this is not a Debian system.*name their folder with --models"):
        catalogue_sources(None, tmp_path / "cache", 1)
    with pytest.raises(InputError, match=r"is not a folder: name the one that holds KiCad's"):
        catalogue_sources(tmp_path / "absent", tmp_path / "cache", 1)


def test_extracts_only_what_is_named_from_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    if not kicad.shutil.which("dpkg-deb"):
        pytest.skip("dpkg-deb is not here: Debian packages cannot be made or read")
    names = ["Family.3dshapes/part,1", "Family.3dshapes/other [2]"]
    inside = tmp_path / "root" / "usr/share/kicad/3dmodels/Family.3dshapes"
    inside.mkdir(parents=True)
    for name in ("part,1", "other [2]", "unwanted"):
        (inside / f"{name}.step").write_text(name)
    control = tmp_path / "root" / "DEBIAN"
    control.mkdir()
    (control / "control").write_text(
        "Package: kicad-packages3d\nVersion: 1\nArchitecture: all\nMaintainer: nobody <nobody@localhost>\n"
        "Description: test\n"
    )

    def download(command: list[str], folder: str, failure: str, check: bool = True) -> None:
        if command[0] == "apt-get":
            command = ["dpkg-deb", "--build", str(tmp_path / "root"), f"{folder}/kicad-packages3d_1_all.deb"]
        original(command, folder, failure, check)

    original = kicad._run
    monkeypatch.setattr(kicad, "_run", download)
    kicad._extract_missing(names, tmp_path / "cache")
    assert sorted(path.name for path in (tmp_path / "cache").rglob("*.*") if path.is_file()) == (
        ["other [2].step", "part,1.step"]
    )
    assert (tmp_path / "cache" / f"{names[0]}.step").read_text() == "part,1"
    with pytest.raises(InputError, match=r"does not hold Family\.3dshapes/absent\.step"):
        kicad._extract_missing(["Family.3dshapes/absent"], tmp_path / "cache")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["electronics", "--models", "absent"], "error: absent is not a folder"),
        (
            ["electronics", "--models", "experiments"],
            " is missing, and 1506 more of 1507 cannot be used: nothing was built",
        ),
        (["per-object", "--cad", "experiments"], "experiments is a folder, and no CAD file: nothing was built"),
        (["cad-folder", "--cad", "README.md"], "README.md is not a folder"),
        (["cad-folder", "--cad", "docs"], "docs holds 0 CAD files (.stl, "),
        (["cad-folder", "--cad", "experiments/assets", "--folder", "/proc/x"], "/proc/x cannot be written to: "),
        (["cad-folder", "--cad", "docs", "--every", "1"], "every is 1, but must be a whole number of 2 or more"),
        (["electronics", "--models", "experiments", "--limit", "0"], "limit = 0 must be 1 or more"),
        (["electronics", "--pack.drops", "-1"], "drops = -1 must be 0 or more"),
        (["check", "--folder", "experiments"], "manifest.json cannot be read"),
    ],
)
def test_build_data_ends_with_one_sentence_for_bad_input(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["build_data", *arguments])
    with pytest.raises(SystemExit) as ended:
        build_data.main()
    assert ended.value.code
    assert message in f"{ended.value.code}{''.join(capsys.readouterr())}"


def test_small_pack_is_whole_and_of_the_recipe() -> None:
    pack = Pack(ASSETS / "small_pack")
    assert pack.problems() == []
    assert sorted(pack.names()) == sorted(SMALL_PACK)
    assert (len(pack.names("train")), len(pack.names("validation"))) == (4, 2)
    assert "CC-BY-SA 4.0" in pack.manifest["licence"]
    for name in pack.names():
        item = pack.load(name)
        assert [len(drop.scene.T_bin_object) for drop in item.drops] == [2, 4, 6, 8, 10, 12, 14, 16, 18, 20]
        extents = np.linalg.norm(np.ptp(item.points, axis=0))
        assert 0.95 * item.diameter < extents < 3**0.5 * item.diameter
        for drop in item.drops:
            assert drop.bits is not None
            visible = np.unpackbits(drop.bits, axis=1).mean(axis=1)
            assert 0.05 < visible.mean() < 0.6  # at most about half of a surface faces the camera
            assert reach_beyond_bin(item, drop.scene).max() < 0.003 * item.diameter


def test_check_counts_copies_outside_and_names_damaged_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    good = run("experiments.build_data", "check", "--folder", str(ASSETS / "small_pack"))
    assert good.returncode == 0, good.stderr
    assert "6 objects, 0 of them damaged; 60 scenes, 660 copies, 0 of them" in good.stdout

    def failed(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["build_data", "check", *arguments])
        with pytest.raises(SystemExit) as ended:
            build_data.main()
        assert ended.value.code == 1
        return capsys.readouterr().out

    assert "6 objects, 0 of them damaged" in failed("--folder", str(ASSETS / "small_pack"), "--tolerance", "-0.1")
    shutil.copytree(ASSETS / "small_pack", tmp_path / "pack")
    name = Pack(tmp_path / "pack").names()[0]
    (tmp_path / "pack" / "objects" / f"{name}.safetensors").write_bytes(b"")
    damaged = failed("--folder", str(tmp_path / "pack"))
    assert f"{name}.safetensors does not match" in damaged
    assert "6 objects, 1 of them damaged; 50 scenes" in damaged


def test_reach_beyond_the_bin_is_that_of_the_farthest_point() -> None:
    item = Pack(ASSETS / "small_pack").load(SMALL_PACK[0], visibility=False)
    scene = item.drops[0].scene
    moved = scene.T_bin_object.copy()
    before = reach_beyond_bin(item, scene)
    moved[0, 2, 3] -= 0.5
    after = reach_beyond_bin(item, replace(scene, T_bin_object=moved))
    lowest = (item.points @ moved[0, :3, :3].T + moved[0, :3, 3])[:, 2].min()
    np.testing.assert_allclose(after[0], -lowest, rtol=1e-5)
    np.testing.assert_array_equal(after[1:], before[1:])


@pytest.mark.parametrize("object_id", [1, 2])
def test_poses_of_the_small_test_set_reproject(object_id: int, record_property: pytest.RecordProperty) -> None:
    """The stored depth is what the stored models, poses, camera and bin give, to half a quantisation step."""
    folder = ASSETS / "small_test_set"
    dataset = BopDataset(folder, "test")
    assert dataset.problems() == ()
    model = dataset.model(object_id)
    assert model.path is not None
    loaded = read_mesh(model.path, "mm")
    mesh = RayMesh(loaded.vertices, loaded.triangles)
    cameras = json.loads((folder / "test" / f"{object_id:06d}" / "scene_camera.json").read_text())
    frames = [key for key in dataset.keys if key.scene_id == object_id]
    assert len(frames) == 4
    for key in frames:
        frame = dataset.frame(*key, masks=True)
        assert frame.instances is not None
        assert frame.bin is not None
        assert frame.T_camera_bin is not None
        poses = np.stack([instance.T_camera_object for instance in frame.instances])
        T_bin_object = np.linalg.inv(frame.T_camera_bin) @ poses
        seen = render(mesh, BinScene(frame.bin, T_bin_object, frame.camera, frame.T_camera_bin))
        on_object = (seen.instances >= 0) & (seen.instances < len(poses)) & (frame.depth > 0)
        step = cameras[str(key.image_id)]["depth_scale"]
        error = np.abs(seen.depth - frame.depth)[on_object]
        record_property("median depth error over the step", f"{np.median(error) / step:.2f}")
        assert np.median(error) < step / 2 * 1.01
        assert np.percentile(error, 99) < 2 * step
        assert frame.visible_masks is not None
        same = frame.visible_masks == (seen.instances == np.arange(len(poses))[:, None, None])
        assert same.mean() > 0.9999
        stored = np.array([instance.visible_fraction for instance in frame.instances])
        np.testing.assert_allclose(seen.visible_fraction, stored, atol=0.005)


def test_digests_of_the_test_sets_are_recorded_with_what_made_them() -> None:
    record = json.loads(test_sets.DIGESTS.read_text())
    assert set(record["sets"]) == {"electronics", "industrial"}
    assert set(record["made_with"]) == set(test_sets.made_with())
    assert len(test_sets.industrial_sources()) == 7
    assert test_sets.is_unexplained("electronics", "0" * 64) == (record["made_with"] == test_sets.made_with())
    assert "differs from test_sets.json" in test_sets.verdict("electronics", "0" * 64)
    assert not test_sets.is_unexplained("unheard of", "0" * 64)
    assert "no digest" in test_sets.verdict("unheard of", "0" * 64)
    if record["made_with"] == test_sets.made_with():
        assert test_sets.verdict("electronics", record["sets"]["electronics"]) == "as recorded"


def threads(workers: int | None, mp_context: object) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers)


def test_builds_a_test_set_seen_by_a_sensor_and_keeps_recipes_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = [source for source in test_sets.industrial_sources() if source.name == "shaft"]
    config = PackConfig(drops=1, copies=(2, 2), cameras=CameraConfig(width=243, height=150), random_seed=1)
    sensor = SensorConfig(noise=0.0015, max_slant=70.0)
    # Processes of their own are started once; then threads stand for them.
    executors = iter((ProcessPoolExecutor, threads, threads, threads))
    monkeypatch.setattr(test_sets, "ProcessPoolExecutor", lambda *given, **named: next(executors)(*given, **named))
    digests = {
        name: test_sets.build_test_set(tmp_path / name, sources, config, chosen, workers=1)
        for name, chosen in (("exact", SensorConfig()), ("sensed", sensor))
    }
    exact, sensed = (BopDataset(tmp_path / name, "test")[0] for name in digests)
    both = (exact.depth > 0) & (sensed.depth > 0)
    assert 0.5 < both.sum() / (exact.depth > 0).sum() < 0.99  # flanks are missing
    diagonal = float(np.linalg.norm(BopDataset(tmp_path / "exact", "test").model(1).size))
    deviation = np.std((sensed.depth - exact.depth)[both])
    assert 0.0005 * diagonal < deviation < 0.01 * diagonal
    assert digests["exact"] != digests["sensed"]
    assert test_sets.build_test_set(tmp_path / "sensed", sources, config, sensor, workers=1) == digests["sensed"]
    with pytest.raises(InputError, match="sensed holds a test set of another recipe"):
        test_sets.build_test_set(tmp_path / "sensed", sources, config, workers=1)


def test_shows_pack_and_test_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    options = ["--folder", str(tmp_path), "--objects", "1", "--drops", "2", "--crops.num-points", "256"]
    monkeypatch.setattr(sys, "argv", ["show_data", *options])
    show_data.main()
    pictures = sorted(tmp_path.glob("*.png"))
    assert [picture.name[:5] for picture in pictures] == ["pack_", "small"]
    assert all(picture.stat().st_size > 20_000 for picture in pictures)


def test_show_data_names_what_is_missing(tmp_path: Path) -> None:
    result = run("experiments.show_data", "--pack", str(tmp_path), "--folder", str(tmp_path / "pictures"))
    assert result.returncode == 1
    assert result.stderr.startswith("error: ")
    assert "manifest.json cannot be read" in result.stderr


def test_packs_are_made_of_ones_own_files(tmp_path: Path) -> None:
    cad = tmp_path / "cad"
    (cad / "more").mkdir(parents=True)
    assets = ROOT / "experiments" / "assets" / "industrial"
    for name, source in (("b.stl", "screw"), ("more/c.STL", "gear_motor"), ("a.stl", "screw")):
        shutil.copy(assets / f"{source}.stl", cad / name)
    (cad / "notes.txt").touch()
    (cad / "folder.stl").mkdir()
    own = build_data.CadFolder(cad, tmp_path / "pack", every=2, workers=1, pack=PackConfig(drops=0))
    own.run()
    pack = Pack(tmp_path / "pack")
    assert (pack.names("validation"), pack.names("train")) == (["a.stl", "more/c.STL"], ["b.stl"])
    assert not pack.problems()
    own.run()  # goes on
    for change in (
        lambda: (cad / "b.stl").write_bytes((cad / "more" / "c.STL").read_bytes()),
        lambda: (cad / "b.stl").unlink(),
    ):
        change()
        with pytest.raises(
            InputError, match="holds a pack of other files than these: choose another folder, or delete it"
        ):
            own.run()
    (cad / "a.stl").write_bytes(b"broken")
    with pytest.raises(InputError, match="has no object for validation: none of their files could be used"):
        replace(own, folder=tmp_path / "other").run()


def test_surfels_are_of_components_and_of_parts_made_by_parameters(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    component = build_data.Source(
        "component", "validation", ROOT / "experiments" / "assets" / "industrial" / "screw.stl"
    )
    monkeypatch.setattr(build_data, "catalogue_sources", lambda *given: ([component], "a licence"))
    monkeypatch.setattr(build_data, "TRAINING_FAMILIES", ["clip", "cup"])
    build_data.AllSurfels(tmp_path, parts=1, workers=1).run()
    pack = Pack(tmp_path)
    assert set(pack.names("train")) == {"clip_0", "cup_0"}
    assert pack.names("validation") == ["component"]
    assert not pack.problems()
    assert not pack.load("clip_0").drops
    assert not list(tmp_path.glob("tmp*"))
