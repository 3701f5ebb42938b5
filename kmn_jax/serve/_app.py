"""The requests that a server answers."""

# FastAPI reads the annotations of the functions below: here they are no strings.

import functools
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Annotated, Any, Literal, get_origin
from urllib.parse import quote

from fastapi import APIRouter, Depends, FastAPI, File, Form, Request, UploadFile
from fastapi.exceptions import RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from fastapi.routing import APIRoute
from starlette import datastructures
from starlette.exceptions import HTTPException

from kmn_jax import __version__
from kmn_jax.detection import Effort
from kmn_jax.errors import InputError
from kmn_jax.io import size_question
from kmn_jax.objects import Part
from kmn_jax.serve._gate import Gate
from kmn_jax.serve._messages import DetectionResult, Health, PartInfo, PartList, Problem
from kmn_jax.serve._metrics import Metrics
from kmn_jax.serve._page import page
from kmn_jax.serve._parts import check_name
from kmn_jax.serve._searches import Question, Searches, Upload
from kmn_jax.serve._settings import ServeConfig, Units
from kmn_jax.serve._worker import Worker

_WARMING_UP = "the server is still compiling: ask /health when it is ready"
_PROBLEMS: dict[int | str, dict[str, Any]] = {
    400: {"model": Problem, "description": "Bad input"},
    413: {"model": Problem, "description": "Too large"},
    415: {"model": Problem, "description": "No multipart/form-data, or with a charset"},
    422: {"model": Problem, "description": "Not the fields that are asked for"},
    503: {"model": Problem, "description": "Too much to do, or not ready: try again after the seconds of Retry-After"},
    504: {"model": Problem, "description": "Took too long"},
}
_UNKNOWN: dict[int | str, dict[str, Any]] = {404: {"model": Problem, "description": "Not known"}}
_PNG: dict[int | str, dict[str, Any]] = {200: {"content": {"image/png": {}}, "description": "The picture"}}


async def only_known_fields(request: Request) -> None:
    """Refuse a field that a request does not have, or has once: it would be ignored without a word."""
    route, sent = request.scope["route"], [name for name, _ in (await request.form()).multi_items()]
    assert isinstance(route, APIRoute)
    known = {field.alias: field.field_info.annotation for field in route.dependant.body_params}
    for name in sent:
        if name not in known:
            raise HTTPException(422, f"{name[:80]!r} is not known: the fields are {', '.join(known)}")
        if sent.count(name) > 1 and get_origin(known[name]) is not list:
            raise HTTPException(422, f"{name} is sent {sent.count(name)} times, but has one value")


router = APIRouter()


class Service:
    """What requests share."""

    def __init__(self, searches: Searches, config: ServeConfig) -> None:
        self.searches, self.store = searches, searches.store
        self.worker = Worker(config.most_queued, config.time_limit)
        self.metrics = Metrics(lambda: self.worker.queued, lambda: len(self.store.named()))
        self.is_ready = False

    async def run(self, request: Request, job: Callable[[], Any]) -> Any:
        """Return what a job of the worker returns, once the server is ready."""
        if not self.is_ready:
            raise HTTPException(503, _WARMING_UP, {"Retry-After": "5"})
        return await self.worker.run(job, functools.partial(_gone, request))


def make_app(
    searches: Searches,
    config: ServeConfig,
    warm_up: Callable[[], Any] | None = None,
    ready: Callable[[], None] = lambda: None,
) -> FastAPI:
    """Return an ASGI application; it is ready when `warm_up` has returned, and then calls `ready`."""
    service = Service(searches, config)

    @asynccontextmanager
    async def life(app: FastAPI) -> AsyncIterator[None]:
        def warm() -> None:
            if warm_up is not None:
                warm_up()
            service.is_ready = True
            ready()

        warming = service.worker.start(warm)
        yield
        service.worker.close()
        warming.cancel()

    # The pages of FastAPI load scripts from elsewhere; ours is made of the same document.
    app = FastAPI(
        title="kmn_jax",
        version=__version__,
        summary="Poses of parts in a bin, from their CAD models and a scan",
        docs_url=None,
        redoc_url=None,
        lifespan=life,
    )
    app.state.service = service
    app.include_router(router)
    app.add_exception_handler(InputError, _bad_input)
    app.add_exception_handler(RequestValidationError, _bad_fields)
    app.add_exception_handler(HTTPException, _refused)
    app.add_exception_handler(Exception, _own_fault)
    app.add_middleware(Gate, config=config)
    app.add_middleware(service.metrics.around)
    return app


@router.get("/health", responses={503: {"model": Health, "description": "Still compiling"}})
async def health(request: Request, response: Response) -> Health:
    """Tell whether searches are answered."""
    service = _service(request)
    response.status_code = 200 if service.is_ready else 503
    return Health(
        status="ready" if service.is_ready else "warming up",
        version=__version__,
        weights=service.searches.weights,
        parts=len(service.store.named()),
        queued=service.worker.queued,
    )


@router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
async def metrics(request: Request) -> Response:
    """Return counters in Prometheus's format."""
    return Response(_service(request).metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")


@router.get("/parts")
async def list_parts(request: Request) -> PartList:
    """Return the parts that have names."""
    return PartList(parts=[_info(name, part) for name, part in _service(request).store.named().items()])


@router.get("/parts/{name}", responses=_UNKNOWN)
async def show_part(request: Request, name: str) -> PartInfo:
    """Return one part."""
    return _info(name, _known(_service(request), name))


@router.put(
    "/parts/{name}",
    responses=_PROBLEMS | {201: {"model": PartInfo, "description": "A new part"}},
    dependencies=[Depends(only_known_fields)],
)
async def prepare_part(
    request: Request,
    response: Response,
    name: str,
    file: Annotated[UploadFile, File(description="CAD file, cloud of the whole surface, or object card")],
    units: Annotated[Units, Form(description="of the file's lengths; auto: what it says, else millimetres")] = "auto",
) -> PartInfo:
    """Prepare a part from a file, and keep it under a name; one that had the name before is replaced."""
    service, upload = _service(request), _upload(file)
    check_name(name)

    def prepare() -> tuple[Part, bool]:  # kept even if the answer comes too late
        part = service.searches.prepare(upload, units)
        return part, service.store.add(name, part)

    part, is_new = await service.run(request, prepare)
    response.status_code = 201 if is_new else 200
    return _info(name, part)


@router.delete("/parts/{name}", status_code=204, responses=_UNKNOWN)
async def delete_part(request: Request, name: str) -> None:
    """Forget a part."""
    if not _service(request).store.remove(name):
        raise HTTPException(404, _unknown(name))


@router.post(
    "/detect",
    response_model=DetectionResult,
    responses=_PROBLEMS | _UNKNOWN,
    dependencies=[Depends(only_known_fields)],
)
async def detect(
    request: Request,
    scene: Annotated[UploadFile, File(description="cloud or depth image")],
    part: Annotated[str | None, Form(description="name of a part")] = None,
    object: Annotated[UploadFile | None, File(description="CAD file or card, instead of a part's name")] = None,
    camera: Annotated[UploadFile | None, File(description="JSON with fx, fy, cx, cy, or cam_K")] = None,
    background: Annotated[UploadFile | None, File(description="scan of the empty bin")] = None,
    at: Annotated[list[str], Form(description="X,Y,Z: only the copy at this point")] = [],  # noqa: B006
    units: Annotated[Units, Form(description="of the scan; auto: what its format says, else the part's")] = "auto",
    object_units: Annotated[Units, Form(description="of the file `object`")] = "auto",
    random_seed: Annotated[int, Form()] = 0,
    roi: Annotated[str | None, Form(description="6 or 9 numbers with commas between them")] = None,
    plane: Annotated[Literal["auto", "always", "never"], Form()] = "auto",
    effort: Annotated[Effort, Form()] = "usual",
    sensor: Annotated[str | None, Form(description="X,Y,Z of the sensor in the scan's frame")] = None,
    top: Annotated[int | None, Form(description="return the first poses only")] = None,
    picture: Annotated[bool, Form(description="draw one; the header Picture says where it is")] = False,
) -> Response:
    """Search a scan for the copies of a part. The fields mean what the flags of `kmn detect` do."""
    service = _service(request)
    sent = None if object is None else _upload(object)
    if (part is None) == (sent is None):
        raise InputError("give either the name of a part, or the file of an object")
    known = None if part is None else _known(service, part)
    asked = Question(
        _upload(scene),
        None if camera is None else _upload(camera),
        None if background is None else _upload(background),
        tuple(at),
        units,
        random_seed,
        roi,
        plane,
        effort,
        sensor,
        top,
        picture,
    )

    def search() -> tuple[str, dict[str, Any], str | None]:
        if sent is not None:
            key, found = service.searches.part_of(sent, object_units)
            return key, *service.searches.search(found, sent.name, asked)
        assert part is not None
        assert known is not None
        return part, *service.searches.search(known, part, asked)

    called, result, drawn = await service.run(request, search)
    timing = result["timing"]
    service.metrics.search_seconds.observe(timing["total_s"])
    service.metrics.poses.inc(len(result["poses"]))
    headers = {"Part": f"/parts/{quote(called)}"}
    if drawn is not None:
        headers["Picture"] = f"/pictures/{drawn}"
    return JSONResponse(result, headers=headers)


@router.get("/pictures/{name}", response_class=Response, responses=_PNG | _UNKNOWN)
async def fetch_picture(request: Request, name: str) -> Response:
    """Return a picture of one of the last searches that asked for one (PNG)."""
    content = _service(request).searches.picture(name)
    if content is None:
        raise HTTPException(404, "there is no such picture, or it is too old: search again")
    return Response(content, media_type="image/png")


@router.get("/", include_in_schema=False)
async def front(request: Request) -> Response:
    """Show the page of requests."""
    return RedirectResponse("/docs")


@router.get("/docs", include_in_schema=False)
async def docs(request: Request) -> Response:
    """Show which requests there are."""
    policy = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; frame-ancestors 'none'"}
    return HTMLResponse(page(request.app.openapi()), headers=policy)


def _service(request: Request) -> Service:
    service = request.app.state.service
    assert isinstance(service, Service)
    return service


def _known(service: Service, name: str) -> Part:
    part = service.store.find(name)
    if part is None:
        raise HTTPException(404, _unknown(name))
    return part


def _unknown(name: str) -> str:
    return f"there is no part {name[:80]!r}: prepare it by a PUT to /parts/NAME"


def _upload(file: datastructures.UploadFile) -> Upload:
    return Upload(file.filename or "", file.file)


def _info(name: str, part: Part) -> PartInfo:
    return PartInfo(
        name=name,
        label=part.name,
        unit=part.unit,
        diameter=part.diameter,
        size=(part.maximum - part.minimum).tolist(),
        is_symmetric=part.is_symmetric,
        source_digest=part.source_digest,
        question=size_question(part.diameter, part.unit, "units={}"),
    )


async def _gone(request: Request) -> None:
    """Return when the client has closed the connection; the body has been read by then."""
    while (await request.receive())["type"] != "http.disconnect":
        pass


async def _bad_input(request: Request, error: Exception) -> Response:
    return _problem(400, str(error))


async def _bad_fields(request: Request, error: Exception) -> Response:
    assert isinstance(error, RequestValidationError)
    first = error.errors()[0]
    name, said = ".".join(map(str, first["loc"][1:])) or "the body", first["msg"]
    if "UploadFile" in said:
        said = f"a text was sent in place of a file (with curl, a file is -F {name}=@FILE)"
    return _problem(422, f"{name}: {said}")


async def _refused(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    return _problem(error.status_code, str(error.detail), error.headers)


async def _own_fault(request: Request, error: Exception) -> Response:
    return _problem(500, f"the server failed by a fault of its own ({type(error).__name__}); its log says where")


def _problem(status: int, sentence: str, headers: Any = None) -> Response:
    return JSONResponse({"error": sentence}, status, headers)
