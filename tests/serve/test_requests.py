"""What the server answers: parts, searches, pictures, health, metrics, the page; and one sentence for bad input."""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args, get_type_hints

import numpy as np
import pytest

from kmn_jax.detection import FAST, THOROUGH, as_json
from kmn_jax.objects import Part
from kmn_jax.released import RELEASED
from kmn_jax.serve import ServeConfig, detect_on_server
from kmn_jax.serve._app import detect
from kmn_jax.serve._messages import DetectionResult, Health, PartInfo, PartList, PoseInfo, Problem
from kmn_jax.serve._searches import stored_name
from tests.serve.serve_sample import FOUND, KnownAnswer, Running, eventually, running, some_scan

SCAN = ("scan.ply", some_scan())


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with running(tmp_path_factory.mktemp("private"), ServeConfig(port=0, most_parts=3)) as one:
        yield one


def test_parts_are_prepared_listed_shown_replaced_and_deleted(server: Running) -> None:
    status, said, _ = server.send("PUT", "/parts/motor-1.a", file=("gear motor.stl", b"solid"), units="mm")
    assert status == 201
    info = PartInfo.model_validate(said)
    assert (info.name, info.label, info.unit) == ("motor-1.a", "gear motor", "mm")
    np.testing.assert_allclose(info.size, [1.0, 0.7, 0.4])
    assert info.question is None
    assert server.send("PUT", "/parts/motor-1.a", file=("other.stl", b"solid"))[0] == 200
    assert server.ask("GET", "/parts/motor-1.a")[1]["label"] == "other"
    assert server.send("PUT", "/parts/a", file=b"solid")[0] == 201
    assert [part.name for part in PartList.model_validate(server.ask("GET", "/parts")[1]).parts] == ["a", "motor-1.a"]
    assert server.send("PUT", "/parts/b", file=b"solid")[0] == 201
    status, said, _ = server.send("PUT", "/parts/c", file=b"solid")
    assert (status, said["error"]) == (400, "there are 3 parts already: delete one first")
    for name in ("a", "b", "motor-1.a"):
        assert server.ask("DELETE", f"/parts/{name}")[0] == 204
        assert server.ask("DELETE", f"/parts/{name}")[0] == 404
        assert server.ask("GET", f"/parts/{name}")[0] == 404
    assert server.ask("GET", "/parts")[1] == {"parts": []}


def test_a_preparation_that_takes_too_long_is_not_lost(tmp_path: Path) -> None:
    may_end = threading.Event()

    class Slow(KnownAnswer):
        def prepare(self, path: Any, unit: str | None = None, name: str | None = None) -> Part:
            assert may_end.wait(30)
            return super().prepare(path, unit, name)

    with running(tmp_path, ServeConfig(port=0, time_limit=0.3), Slow()) as server:
        assert server.send("PUT", "/parts/a", file=("a.stl", b"solid"))[0] == 504
        may_end.set()
        eventually(lambda: server.ask("GET", "/parts/a")[0] == 200)


@pytest.mark.parametrize("name", [".hidden", "a%2Fb", "..%2F..%2Fetc", "%00", "a" * 65, "ß", "-"])
def test_names_that_are_none_are_refused(server: Running, name: str) -> None:
    from urllib.parse import quote

    status, said, _ = server.send("PUT", f"/parts/{quote(name, safe='%')}", file=b"solid")
    assert status in (400, 404)
    assert server.ask("GET", "/parts")[1] == {"parts": []}
    assert status == 404 or "cannot name a part" in said["error"]


def test_a_search_answers_as_the_command_writes(server: Running) -> None:
    assert server.send("PUT", "/parts/box", file=("box.stl", b"solid"))[0] == 201
    del server.known.asked[:]
    status, said, headers = server.send(
        "POST",
        "/detect",
        part="box",
        scene=SCAN,
        camera=b"{}",
        background=some_scan(),
        at=["1,2,3", "-4,5,6"],
        units="m",
        random_seed=7,
        roi="0,0,0,1,1,1",
        plane="never",
        sensor="0,0,-1",
    )
    assert status == 200, said
    DetectionResult.model_validate(said)
    assert all(pose.keys() == PoseInfo.model_fields.keys() for pose in said["poses"])
    expected = as_json(FOUND, "box", "scan.ply", {"seed": 7, "weights": RELEASED, "model": "0"})
    assert said | {"timing": 0} == expected | {"timing": 0}
    assert {"total_s", "compile_s"} <= said["timing"].keys()
    assert headers["Part"] == "/parts/box"
    (asked,) = server.known.asked
    assert asked["content"] == SCAN[1]
    assert asked["unit"] == "m"
    assert asked["camera"].name == "camera.bin"
    np.testing.assert_array_equal(asked["at"], [[1, 2, 3], [-4, 5, 6]])
    np.testing.assert_array_equal(asked["sensor"], [0, 0, -1])
    options = asked["background"]
    assert (options.roi, options.remove_plane) == ((0, 0, 0, 1, 1, 1), "never")
    assert options.background.points.tobytes() == some_scan()
    assert server.ask("DELETE", "/parts/box")[0] == 204


def test_a_part_may_come_with_the_scan_and_is_remembered(server: Running) -> None:
    status, said, headers = server.send("POST", "/detect", object=("nut.stl", b"solid"), scene=SCAN, top=1)
    assert status == 200
    assert (said["object"], len(said["poses"])) == ("nut.stl", 1)
    assert server.ask("GET", headers["Part"])[1]["label"] == "nut"
    assert server.ask("GET", "/parts")[1] == {"parts": []}
    again = server.send("POST", "/detect", object=("nut.stl", b"solid"), scene=SCAN)[2]
    assert again["Part"] == headers["Part"]
    for number in range(3):  # as many as are remembered
        assert server.send("POST", "/detect", object=("nut.stl", b"solid %d" % number), scene=SCAN)[0] == 200
    assert server.ask("GET", headers["Part"])[0] == 404


def test_a_picture_is_drawn_when_it_is_asked_for(server: Running) -> None:
    headers = server.send("POST", "/detect", object=b"solid", scene=SCAN, picture="true")[2]
    status, content, said = server.ask("GET", headers["Picture"])
    assert (status, said.get_content_type()) == (200, "image/png")
    assert content.startswith(b"\x89PNG")
    assert "Picture" not in server.send("POST", "/detect", object=b"solid", scene=SCAN)[2]
    assert server.ask("GET", "/pictures/other")[0] == 404


def test_files_are_written_into_the_private_folder_only_and_not_kept(server: Running, tmp_path: Path) -> None:
    del server.known.asked[:]
    for name in (
        "../../escape.ply",
        "/etc/escape.ply",
        "..\\escape.ply",
        "..",
        "",
        ".ply",
        "a" * 300 + ".ply",
        "語" * 99 + ".ply",
    ):
        assert server.send("POST", "/detect", object=("a.stl", b"solid"), scene=(name, b"content"))[0] in (200, 422)
    assert server.known.asked
    for asked in server.known.asked:
        assert asked["folder"].parent == server.folder
        assert not asked["folder"].exists()
    assert list(server.folder.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "stored"),
    [
        ("scan.ply", "scan.ply"),
        ("größe 2.PLY", "größe 2.PLY"),
        ("../../a.ply", "a.ply"),
        ("C:\\x\\a.ply", "a.ply"),
        ("..", "scene"),
        ("", "scene"),
        (".ply", "scene.ply"),
        ("a\n\x00:b.ply", "a___b.ply"),
        ("a" * 300 + ".ply", "a" * 30 + ".ply"),
        ("語" * 99 + ".ply", "語" * 30 + ".ply"),
        ("a." + "\U00020000" * 99, "a." + "\U00020000" * 30),
    ],
)
def test_names_of_files_are_made_safe(name: str, stored: str) -> None:
    assert stored_name(name, "scene") == stored
    assert len(stored.encode()) <= 255


def test_bad_input_is_one_sentence(server: Running, capfd: pytest.CaptureFixture[str]) -> None:
    one: dict[str, object] = {"object": ("a.stl", b"solid"), "scene": SCAN}
    cases: list[tuple[dict[str, object], int, str]] = [
        ({"scene": SCAN}, 400, "give either the name of a part, or the file of an object"),
        (one | {"part": "a"}, 400, "give either the name of a part, or the file of an object"),
        ({"part": "none", "scene": SCAN}, 404, "there is no part 'none': prepare it by a PUT to /parts/NAME"),
        (one | {"object": ("bad.stl", b"broken")}, 400, "bad.stl cannot be used: it is broken"),
        (one | {"at": "1,2"}, 400, "at is '1,2', but must be 3 numbers with commas between them"),
        (one | {"roi": "1,2,3"}, 400, "roi is '1,2,3', but must be 6 or 9 numbers with commas between them"),
        (one | {"roi": "1,1,1,0,0,0"}, 400, "each min below its max"),
        (one | {"sensor": "nan,0,0"}, 400, "sensor is 'nan,0,0'"),
        (one | {"top": 0}, 400, "top is 0, but must be a whole number of 1 or more"),
        (one | {"units": "km"}, 422, "units: Input should be"),
        (one | {"rio": "0,0,0,1,1,1"}, 422, "'rio' is not known: the fields are scene, part, object, camera, "),
        (one | {"top": ["1", "2"]}, 422, "top is sent 2 times, but has one value"),
        (one | {"random_seed": "x"}, 422, "random_seed: Input should be a valid integer"),
        ({"object": ("a.stl", b"solid")}, 422, "scene: Field required"),
        ({"object": ("a.stl", b"solid"), "scene": "text"}, 422, "scene: a text was sent in place of a file"),
    ]
    for fields, status, sentence in cases:
        code, said, _ = server.send("POST", "/detect", **fields)
        assert code == status, said
        assert sentence in Problem.model_validate(said).error
        assert "\n" not in said["error"]
    for body, kind in ((b"{", "application/json"), (b"garbage", "multipart/form-data; boundary=x"), (b"", "")):
        code, said, _ = server.ask("POST", "/detect", body, {"Content-Type": kind})
        assert 400 <= code < 500, (body, said)
        assert "\n" not in Problem.model_validate(said).error
    assert server.ask("GET", "/nowhere")[:2] == (404, {"error": "Not Found"})
    assert server.ask("PATCH", "/parts")[:2] == (405, {"error": "Method Not Allowed"})
    assert capfd.readouterr().err == ""


def test_our_own_fault_is_told_as_one_and_the_server_lives_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with running(tmp_path) as server:
        status, said, _ = server.send("POST", "/detect", object=b"solid", scene=b"fault")
        assert status == 500
        assert said["error"] == "the server failed by a fault of its own (RuntimeError); its log says where"
        logged = ""
        end = time.monotonic() + 20
        while "RuntimeError: a fault of ours" not in logged:  # after the answer
            assert time.monotonic() < end, logged
            time.sleep(0.01)
            logged += capsys.readouterr().err
        assert server.send("POST", "/detect", object=b"solid", scene=SCAN)[0] == 200


def test_metrics_count_requests_and_searches(server: Running) -> None:
    def value(line: str) -> float:
        text = server.ask("GET", "/metrics")[1].decode()
        return sum(float(one.rpartition(" ")[2]) for one in text.splitlines() if one.startswith(line))

    requests = 'kmn_requests_total{method="POST",route="/detect",status="200"}'
    before = [value(name) for name in (requests, "kmn_search_seconds_count", "kmn_poses_total")]
    assert server.send("POST", "/detect", object=b"solid", scene=SCAN)[0] == 200
    after = [value(name) for name in (requests, "kmn_search_seconds_count", "kmn_poses_total")]
    assert np.subtract(after, before).tolist() == [1, 1, 2]
    assert value("kmn_queue_length") == 0
    assert value("process_resident_memory_bytes") > 1e6
    for number in range(5):
        server.ask("GET", f"/made/up/{number}")
        assert server.ask(f"MADEUP{number}", "/parts")[0] == 405
    text = server.ask("GET", "/metrics")[1].decode()
    assert "/made/up" not in text
    assert "MADEUP" not in text
    assert 'kmn_requests_total{method="other",route="/parts",status="405"}' in text
    assert 'kmn_requests_total{method="other",route="other",status="404"}' in text


def test_the_page_and_the_document_say_what_there_is(server: Running) -> None:
    document = server.ask("GET", "/openapi.json")[1]
    assert set(document["paths"]) == {"/health", "/metrics", "/parts", "/parts/{name}", "/detect", "/pictures/{name}"}
    answer = document["paths"]["/detect"]["post"]["responses"]["200"]["content"]["application/json"]["schema"]
    assert answer == {"$ref": "#/components/schemas/DetectionResult"}
    status, content, headers = server.ask("GET", "/docs")
    assert (status, headers.get_content_type()) == (200, "text/html")
    page = content.decode()
    assert "http://" not in page
    assert "https://" not in page
    assert "<script" not in page
    for words in ("POST /detect", "PUT /parts/{name}", "runner_up_gap", "random_seed", "DetectionResult"):
        assert words in page
    status, _, headers = server.ask("GET", "/")
    assert (status, headers["Location"]) == (307, "/docs")


def test_searches_take_the_effort_that_is_asked_for(server: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    configs = []

    def detect(self: object, *_: object, **__: object) -> object:
        configs.append(self.config)  # type: ignore[attr-defined]
        return FOUND

    monkeypatch.setattr(type(server.known), "detect", detect)
    for effort in ("fast", "usual", "thorough"):
        assert server.send("POST", "/detect", object=b"solid", scene=SCAN, effort=effort)[0] == 200
    assert configs == [FAST, server.known.config, THOROUGH]
    assert server.send("POST", "/detect", object=b"solid", scene=SCAN, effort="more")[0] == 422


def test_it_says_that_it_is_ready_when_all_is_compiled(tmp_path: Path) -> None:
    compiled = threading.Event()
    with running(tmp_path, warm_up=lambda: compiled.wait(30)) as server:
        status, said, _ = server.ask("GET", "/health")
        assert (status, Health.model_validate(said).status) == (503, "warming up")
        status, said, headers = server.send("POST", "/detect", object=b"solid", scene=SCAN)
        assert (status, headers["Retry-After"]) == (503, "5")
        assert "still compiling" in said["error"]
        compiled.set()
        eventually(lambda: server.ask("GET", "/health")[0] == 200)
        assert server.ask("GET", "/health")[1]["status"] == "ready"
        assert server.send("POST", "/detect", object=b"solid", scene=SCAN)[0] == 200


def test_the_client_takes_the_fields_of_a_search() -> None:
    asked, here = inspect.signature(detect).parameters, inspect.signature(detect_on_server).parameters
    assert set(here) - {"server"} == set(asked) - {"request", "object"}  # the file `object` is its `part`
    taken, known = get_type_hints(detect), get_type_hints(detect_on_server)
    for name in [name for name, keyword in here.items() if keyword.kind is keyword.KEYWORD_ONLY and name != "at"]:
        assert (known[name], here[name].default) == (taken[name], asked[name].default), name
    assert list[str] == taken["at"]
    assert str in get_args(known["at"])
