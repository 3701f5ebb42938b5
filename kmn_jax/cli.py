"""The `kmn` command: each subcommand is one function whose signature is its list of flags."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from kmn_jax import __version__
from kmn_jax.arguments import joined, parsed
from kmn_jax.errors import InputError, check_whole, require
from kmn_jax.extras import install_command
from kmn_jax.files import check_inputs, check_outputs, write_whole
from kmn_jax.printing import drop_what_is_printed, open_closed_streams, say
from kmn_jax.released import RELEASED
from kmn_jax.session import Request, Session, Units, unit_of

if TYPE_CHECKING:
    from kmn_jax.serve import ServerAnswer

_STDOUT = Path("-")


def prepare(
    source: Annotated[Path, tyro.conf.Positional],
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"])] = None,
    units: Units = "auto",
    weights: str = RELEASED,
) -> None:
    """Make an object card, so that later calls need not read and encode the CAD file.

    Args:
        source: CAD file (STL, OBJ, PLY, GLB, STEP) or cloud of the whole surface (PLY, PCD, XYZ).
        output: the card; by default beside the source, ending in .kmn.
        units: unit of the source's numbers; auto: what the format says, else millimetres. STEP and GLB files state
            theirs: of them it is the unit that the card will be in.
        weights: released network, or a .safetensors file.
    """
    from kmn_jax.detection import PoseEstimator, describe
    from kmn_jax.io import size_question
    from kmn_jax.objects import CARD_SUFFIX, save_part
    from kmn_jax.programs import ended_by_interrupt

    require(output is None or output.suffix == CARD_SUFFIX, f"--output {output} must end in {CARD_SUFFIX}")
    target = output or source.parent / f"{source.stem}{CARD_SUFFIX}"
    check_outputs((target,), source, Path(weights))
    with ended_by_interrupt():
        part = PoseEstimator.from_pretrained(weights).prepare(source, unit_of(units))
    save_part(part, target)
    say(f"{describe(part)}; wrote {target}")
    question = size_question(part.diameter, part.unit, "--units {}")
    if question is not None:
        say(f"note: {question}")


def detect(
    request: Annotated[Request, tyro.conf.arg(name="")],
    top: int | None = None,
    json: Path | None = None,
    bop_csv: Path | None = None,
    save_picture: Path | None = None,
    server: str | None = None,
) -> None:
    """Find the copies of an object in a scan: poses of the whole bin, in pick order.

    Args:
        request: what to look for, and where.
        top: return the first poses only.
        json: file for the result as JSON, see docs/detect.md; - prints that in place of the table.
        bop_csv: file for the result as BOP's csv.
        save_picture: file for a picture of scene, segmentation, keypoints and poses (PNG).
        server: address of a kmn serve that searches instead of this process.
    """
    from kmn_jax.bop import bop_files
    from kmn_jax.detection import DetectConfig, as_json, json_text, table, write_bop_csv

    if top is not None:
        check_whole(top, "top", 1)
    is_json_printed = json == _STDOUT
    json = None if is_json_printed else json
    read = (*request.files, Path(request.weights), *bop_files(request.scene))
    check_outputs((json, bop_csv, save_picture), *read)
    check_inputs(*request.files)
    if save_picture is not None:
        from kmn_jax.viz import check_drawing, check_picture

        check_picture(save_picture)
        if server is None:
            check_drawing()
    if server is None:
        session = Session(request)
        found, bop_ids = session.detect(session.places, top), session.scene.bop_ids
        facts = {"seed": request.random_seed, "weights": request.weights, "model": session.part.model_digest}
        result = as_json(found, str(request.object), str(request.scene), facts)
    else:
        answer = _ask(request, server, top, save_picture is not None)
        found, bop_ids, result = answer.found, answer.bop_ids, answer.result
    # Files first: whoever reads what is printed may stop reading.
    if json is not None:
        write_whole(json, f"{json_text(result)}\n".encode())
    if bop_csv is not None:
        write_bop_csv(found, bop_csv, *bop_ids)
    if save_picture is not None and server is None:
        from kmn_jax.viz import save_picture as draw

        draw(save_picture, session.scene, session.part, found, session.scene.truth)
    elif save_picture is not None:
        write_whole(save_picture, answer.picture)
    if is_json_printed:
        say(json_text(result))
        return
    written = [f"wrote {target}" for target in (json, bop_csv, save_picture) if target is not None]
    say("\n".join([table(found, DetectConfig().accepted), *written]))


def view(
    request: Annotated[Request, tyro.conf.arg(name="")],
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Show scan, poses and keypoints in the browser; a picked point, or the folder's next scan, is searched there.

    Args:
        request: what to look for, and where.
        host: address to serve on; 0.0.0.0 for other machines, too.
        port: port to serve on.
    """
    from kmn_jax.detection import table
    from kmn_jax.viz import Viewer, check_page, one_after_the_other, part_mesh

    check_page(host, port)
    check_inputs(*request.files)
    session = Session(request)
    found = session.detect(session.places)
    say(table(found, session.estimator.config.accepted))
    with Viewer(
        session.scene,
        session.part,
        found,
        host,
        port,
        on_pick=lambda point: session.detect(point[None]),
        on_next=one_after_the_other(request.scene, session.go_on, request.background),
        mesh=part_mesh(request.object, session.part),
    ) as page:
        say(f"open {page.url}; stop with Ctrl+C")
        page.wait()


def serve(
    parts: Path | None = None,
    example: Path | None = None,
    camera: Path | None = None,
    host: str = "127.0.0.1",
    port: int = 8000,
    allow_host: tyro.conf.UseAppendAction[tuple[str, ...]] = (),
    max_megabytes: float = 100.0,
    max_queue: int = 16,
    time_limit: float = 120.0,
    weights: str = RELEASED,
) -> None:
    """Answer searches over HTTP, as docs/serve.md tells, until the process is told to stop.

    Args:
        parts: folder of CAD files or cards that are prepared at the start and called by their names.
        example: scan like those to come: all that they need is compiled before the server says that it is ready.
        camera: its camera, if it is a depth image.
        host: address to serve on; 0.0.0.0 for other machines, too.
        port: port to serve on; 0 takes any that is free.
        allow_host: name by which other machines may call this one; may be given several times.
        max_megabytes: size of a request.
        max_queue: requests that wait or run; more are told to come again.
        time_limit: seconds until a request is given up.
        weights: released network, or a .safetensors file.
    """
    from kmn_jax.serve import ServeConfig
    from kmn_jax.serve import serve as run

    require(bool(np.isfinite(max_megabytes)), f"--max-megabytes is {max_megabytes}, but must be finite")
    limits = ServeConfig(host, port, allow_host, int(1e6 * max_megabytes), max_queue, time_limit)
    run(limits, weights, parts, example, camera, lambda url: say(f"serving on {url}; stop with Ctrl+C"), say)


def export(
    object: Path,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    units: Units = "auto",
    object_units: Units = "auto",
    points: int = 65_536,
    weights: str = RELEASED,
) -> None:
    """Write the estimator of one part as a file that runs where JAX does, without this package.

    Args:
        object: CAD file, cloud of the whole surface, or object card (.kmn).
        output: the artefact; docs/detect.md tells how to call it.
        units: unit of the scans that the artefact will be given, and of its poses; auto: that of the object.
        object_units: unit of the object's numbers, as in kmn detect.
        points: how many points its scans hold at most.
        weights: released network, or a .safetensors file.
    """
    from kmn_jax.detection import PoseEstimator, export_estimator
    from kmn_jax.programs import ended_by_interrupt

    check_outputs((output,), object, Path(weights))
    with ended_by_interrupt():
        estimator = PoseEstimator.from_pretrained(weights)
        part = estimator.prepare(object, unit_of(object_units))
        part = part.in_unit(unit_of(units) or part.unit)
        size = export_estimator(estimator, part, output, points)
    say(f"wrote {output}: {size / 1e6:.1f} MB, scans of up to {points} points in {part.unit}")


def convert(
    source: Annotated[Path, tyro.conf.Positional],
    target: Annotated[Path, tyro.conf.Positional],
    released_names: bool = False,
) -> None:
    """Convert weights between the authors' checkpoints and kmn_jax models.

    Args:
        source: authors' state dict (.t7, .pt, .pth, .safetensors) or a kmn_jax model (.safetensors).
        target: .safetensors for a kmn_jax model; .t7, .pt or .pth for the authors' form.
        released_names: write the authors' names into a .safetensors target too.
    """
    from kmn_jax.models import is_model_file, load_model, load_released, save_model, save_released

    check_outputs((target,), source)
    model = load_model(source) if is_model_file(source) else load_released(source)
    if target.suffix == ".safetensors" and not released_names:
        save_model(model, target)
    else:
        save_released(model, target)
    say(f"wrote {target}")


def _ask(request: Request, server: str, top: int | None, picture: bool) -> ServerAnswer:
    """Return what a server finds."""
    from kmn_jax.serve import detect_on_server

    if request.weights != RELEASED:
        raise InputError("the server has weights of its own: leave out --weights, or start it with them")
    if request.base_camera is not None or request.grasps is not None:
        raise InputError("a server knows no robot: leave out --base-camera and --grasps, or search here")
    files = (request.object, request.scene, request.camera, request.background)
    names = ("at", "units", "object_units", "random_seed", "roi", "plane", "effort", "sensor")
    fields = {name: getattr(request, name) for name in names}
    return detect_on_server(server, *files, top=top, picture=picture, **fields)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line: 0 is success, 2 bad input (one sentence on stderr), 1 our own failure."""
    arguments = joined(sys.argv[1:] if arguments is None else arguments)
    open_closed_streams()
    try:
        if arguments == ["--version"]:
            say(f"kmn {__version__}")
            return 0
        run = parsed(arguments, (prepare, detect, view, serve, export, convert))
        from kmn_jax.geometry import ask_for_fast_selection
        from kmn_jax.programs import call_in_place, keep_compiled

        ask_for_fast_selection()
        call_in_place()
        keep_compiled()
        run()
        sys.stdout.flush()
    except BrokenPipeError:  # nobody reads on
        drop_what_is_printed()
    except InputError as error:
        print(f"kmn: {error}", file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        wanted = install_command(error.name or "kmn_jax")
        print(f"kmn: this needs packages that are not installed: {wanted}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if "KMN_DEBUG" in os.environ:
            traceback.print_exc()
        reason = str(error).splitlines()[0] if str(error) else "no message"
        print(
            f"kmn: failed by a fault of its own ({type(error).__name__}: {reason}); KMN_DEBUG=1 shows where",
            file=sys.stderr,
        )
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
