"""Searching on a server in place of this machine: part and scan go there, the same result comes back."""

from __future__ import annotations

import http.client
import io
import secrets
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from kmn_jax.bop import bop_object, bop_scan, bop_scene_id, is_bop_image
from kmn_jax.detection import CropPrediction, Detection, Detections, Effort, Timing
from kmn_jax.errors import InputError
from kmn_jax.io import read_file, resolve_unit
from kmn_jax.limits import parse_json
from kmn_jax.serve._settings import Units
from kmn_jax.units import METRES

_SECONDS = 600.0  # that an answer is waited for


@dataclass(frozen=True)
class ServerAnswer:
    """What a server found."""

    result: dict[str, Any]  # what `kmn detect --json` writes; object and scene are called as they are here
    found: Detections  # the same, without what the network predicted
    bop_ids: tuple[int, int, int]  # scene, image and object, of an image of a BOP dataset
    picture: bytes  # PNG, empty if none was asked for


def detect_on_server(
    server: str,
    part: Path,
    scene: Path,
    camera: Path | None = None,
    background: Path | None = None,
    *,
    at: str | Sequence[str] = (),
    units: Units = "auto",
    object_units: Units = "auto",
    random_seed: int = 0,
    roi: str | None = None,
    plane: Literal["auto", "always", "never"] = "auto",
    effort: Effort = "usual",
    sensor: str | None = None,
    top: int | None = None,
    picture: bool = False,
) -> ServerAnswer:
    """Search a scan on the server at an address (`kmn serve`), with its network.

    Keywords are the fields of its request, which mean what the flags of `kmn detect` do; `at` is X,Y,Z, or several such
    places, and `picture` asks for one. Raises InputError if a file cannot be read, if no server answers, and for what
    the server cannot do.
    """
    states_its_unit = is_bop_image(scene) and camera is None
    fields = {
        "at": [at] if isinstance(at, str) else list(at),
        "units": resolve_unit(units, "mm", "mm") if states_its_unit else units,
        "object_units": object_units,
        "random_seed": random_seed,
        "roi": roi,
        "plane": plane,
        "effort": effort,
        "sensor": sensor,
        "top": top,
        "picture": picture,
    }
    files = {"object": (part.name, read_file(part)), "scene": _scan_file(scene, camera)}
    if background is not None:
        files["background"] = _scan_file(background, camera)
    if camera is not None:
        files["camera"] = (camera.name, read_file(camera, "a camera file"))
    body, kind = _form({name: value for name, value in fields.items() if value is not None}, files)
    content, headers = _request(server, "/detect", body, {"Content-Type": kind})
    try:
        result = dict(_parsed(server, content)) | {"object": str(part), "scene": str(scene)}
        said = _parsed(server, _request(server, _place(headers["Part"]))[0])
        drawn = _request(server, _place(headers["Picture"]))[0] if picture else b""
        return ServerAnswer(result, _detections(result, said["label"]), _bop_ids(scene, camera, said), drawn)
    except InputError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f"the server at {server} does not answer as kmn serve does") from None


def _parsed(server: str, content: bytes) -> Any:
    try:
        return parse_json(content)
    except InputError:
        raise InputError(f"the server at {server} does not answer as kmn serve does") from None


def _place(path: str) -> str:
    """Return a path of the same server, or raise ValueError: what follows an address could make it another's."""
    if not path.startswith("/"):
        raise ValueError("no path")
    return path


def _scan_file(path: Path, camera: Path | None) -> tuple[str, bytes]:
    """Return name and content of a scan to send; an image of a BOP dataset takes its camera along."""
    if camera is not None or not is_bop_image(path):
        return path.name, read_file(path, "a scan")
    scan, _ = bop_scan(path)
    assert scan.camera is not None
    assert scan.depth is not None
    matrix = [[scan.camera.fx, 0, scan.camera.cx], [0, scan.camera.fy, scan.camera.cy], [0, 0, 1]]
    content = io.BytesIO()
    np.savez_compressed(content, depth=scan.depth, K=np.array(matrix))
    return f"{path.stem}.npz", content.getvalue()


def _bop_ids(path: Path, camera: Path | None, part: Mapping[str, Any]) -> tuple[int, int, int]:
    if camera is not None or not is_bop_image(path):
        return (0, 0, 1)
    to_mm = METRES[part["unit"]] / METRES["mm"]
    alike = bop_object(path, bop_scan(path)[1], part["diameter"] * to_mm, np.array(part["size"]) * to_mm)
    return bop_scene_id(path), int(path.stem), 1 if alike is None else alike


def _form(fields: Mapping[str, Any], files: Mapping[str, tuple[str, bytes]]) -> tuple[bytes, str]:
    """Return fields and files as multipart/form-data, and its content type."""
    boundary = secrets.token_hex(16)
    pieces = []
    for name, value in fields.items():
        for one in value if isinstance(value, list | tuple) else [value]:
            text = str(one).lower() if isinstance(one, bool) else str(one)
            pieces.append(f'--{boundary}\r\nContent-Disposition: form-data; name="{name}"\r\n\r\n{text}\r\n'.encode())
    for name, (called, content) in files.items():
        quoted = called.replace("\\", "_").replace('"', "_").replace("\r", "_").replace("\n", "_")
        head = f'Content-Disposition: form-data; name="{name}"; filename="{quoted}"'
        pieces += [
            f"--{boundary}\r\n{head}\r\nContent-Type: application/octet-stream\r\n\r\n".encode(),
            content,
            b"\r\n",
        ]
    return b"".join([*pieces, f"--{boundary}--\r\n".encode()]), f"multipart/form-data; boundary={boundary}"


def _request(
    server: str, path: str, body: bytes | None = None, headers: Mapping[str, str] | None = None
) -> tuple[bytes, http.client.HTTPMessage]:
    """Return content and headers of an answer. Redirects are not followed, proxies not used."""
    if urllib.parse.urlsplit(server).scheme not in ("http", "https"):
        raise InputError(f"{server} is no address of a server: it begins with http:// or https://")
    request = urllib.request.Request(server.rstrip("/") + path, body, dict(headers or {}))
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}), _NoRedirects)
    try:
        with opener.open(request, timeout=_SECONDS) as answer:
            return answer.read(), answer.headers
    except urllib.error.HTTPError as error:
        try:
            said = parse_json(error.read())["error"]
        except (ValueError, KeyError, TypeError, OSError, http.client.HTTPException):
            said = f"it answered {error.code} {error.reason}, as kmn serve does not"
        raise InputError(f"the server at {server} says: {said}") from None
    except (OSError, ValueError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        is_sending = isinstance(error, urllib.error.URLError)  # what comes later is no such error
        if is_sending and body and isinstance(reason, BrokenPipeError | ConnectionResetError):
            raise InputError(
                f"what answers at {server} hung up while {len(body) / 1e6:.1f} MB were sent: they may be above"
                " its --max-megabytes, or it is no kmn serve"
            ) from None
        raise InputError(f"no answer from a server at {server} ({reason}): start one with kmn serve") from None


class _NoRedirects(urllib.request.HTTPRedirectHandler):
    """Takes a redirect for an error: scans go to the address that was named alone."""

    def redirect_request(self, *_: Any) -> None:
        """Return no other request."""


def _detections(result: Mapping[str, Any], part: str) -> Detections:
    timing = dict(result["timing"])
    timing.pop("total_s")
    seconds = timing.pop("compile_s")
    stages = {name.removesuffix("_s"): value for name, value in timing.items()}
    poses = tuple(_detection(pose) for pose in result["poses"])
    warnings, reason = tuple(result["warnings"]), result["reason"]
    return Detections(part, result["unit"], poses, Timing(stages, seconds), reason, warnings, result["unexplained"])


def _detection(pose: Mapping[str, Any]) -> Detection:
    shares: Iterable[str] = ("explained", "violated", "occluded", "unknown")
    nothing = CropPrediction(np.zeros((0, 3), np.float32), np.zeros(0, bool), np.zeros(0, int))
    return Detection(
        T_scene_object=np.array(pose["T_scene_object"], dtype=np.float64),
        probability=pose["probability"],
        num_inliers=pose["inliers"],
        visible_fraction=pose["visible_fraction"],
        runner_up_gap=pose["runner_up_gap"],
        seed=np.array(pose["seed"], dtype=np.float64),
        prediction=nothing,
        warnings=tuple(pose["warnings"]),
        **{name: pose[name] for name in shares},
    )
