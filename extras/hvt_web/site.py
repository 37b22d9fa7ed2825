"""The addresses of the page: its files, the WebSocket of each viewer, pictures of stills, and requests."""

from __future__ import annotations

import asyncio
import json
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, RedirectResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import ASGIApp, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from hvt_common.errors import UserError
from hvt_web.access import HEADERS, Access, Role, cookie_name, crowding
from hvt_web.requests import BadRequestError, BusyError, EdgeRequests
from hvt_web.video.pictures import RUNGS
from hvt_web.viewers import Hub, Viewer, packed, text

MOST_MESSAGE_BYTES = 4096
MOST_VIEWERS = 64
_MOST_MESSAGES_A_S = 30
WATCH_PAUSE_S = 0.2
_SOCKET = "/ws"
_COOKIE_S = 30 * 86400
_KINDS = {"js": "text/javascript", "css": "text/css", "html": "text/html", "svg": "image/svg+xml"}
_FILES = {
    one.name: (one.read_bytes(), _KINDS[kind])
    for one in files("hvt_web").joinpath("static").iterdir()
    if (kind := one.name.rpartition(".")[2]) in _KINDS
}
"""Read once: a requested file is a name of this table, never a path."""


class Site:
    """The handlers of the addresses."""

    def __init__(
        self, access: Access, hub: Hub, edge_requests: EdgeRequests, clock: Callable[[], int]
    ) -> None:
        self._access = access
        self._clock = clock
        self._hub = hub
        self._requests = edge_requests

    async def index(self, request: Request) -> Response:
        """The page; a link with a token gives it to the browser to keep."""
        token = request.query_params.get("token")
        if token is None:
            return _file("index.html")
        response = RedirectResponse(".", 303)  # a proxy may show it below a path
        secure = request.url.scheme == "https"
        response.set_cookie(
            cookie_name(request.headers), token, _COOKIE_S, httponly=True, samesite="lax", secure=secure
        )
        return response

    async def file(self, request: Request) -> Response:
        return _file(request.path_params["name"])

    async def admits(self, _: Request) -> Response:
        """Nothing: who is refused got words before; a browser does not tell a page why its WebSocket was."""
        return Response(status_code=204)

    async def still(self, request: Request) -> Response:
        """A picture of a still, or of the base's view of it."""
        edge = self._hub.edges.get(request.path_params["edge"])
        found = edge and edge.pictures.get(request.path_params["still"], request.path_params["which"])
        if not found:
            return PlainTextResponse("there is no such picture any more", 404)
        return Response(
            found[0], media_type=found[1], headers={"Cache-Control": "private, max-age=3600, immutable"}
        )

    async def request_still(self, request: Request) -> Response:
        """A still of a box: JPEG behind a head, as over the WebSocket."""
        edge, body = self._edge(request), await _json_body(request)
        data, about = await run_in_threadpool(self._requests.request_still, edge, body)
        return Response(packed("still", data, edge=edge, **about), media_type="application/octet-stream")

    async def keyframe(self, request: Request) -> Response:
        await run_in_threadpool(self._requests.keyframe, self._edge(request))
        return Response(status_code=204)

    async def settings(self, request: Request) -> Response:
        edge, body = self._edge(request), await _json_body(request)
        await run_in_threadpool(self._requests.set, edge, body)
        return Response(status_code=204)

    def _edge(self, request: Request) -> str:
        # Only one that is known: names become keys of the link.
        edge: str = request.path_params["edge"]
        if edge not in self._hub.edges:
            raise BadRequestError("there is no such edge")
        return edge

    async def socket(self, socket: WebSocket) -> None:
        """A viewer from its coming to its leaving."""
        viewer = Viewer(socket.client.host if socket.client else "")
        viewers = [one for one in self._hub.viewers if not one.hopeless]
        if len(viewers) >= MOST_VIEWERS:
            crowd = crowding((one.address for one in viewers), viewer.address)
            if crowd is None:
                await socket.send_denial_response(PlainTextResponse("too many viewers", 503))
                return
            crowded = next(one for one in viewers if one.address == crowd)
            crowded.give_up("too many viewers: one from another address took this place")
        await socket.accept()
        role: Role = socket.scope["role"]
        viewer.put(text("hello", role=role, rungs=RUNGS, now=self._now_ms()))
        self._hub.join(viewer)
        tasks = [asyncio.ensure_future(one) for one in (self._receive(socket, viewer), _send(socket, viewer))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            self._hub.leave(viewer)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            with suppress(RuntimeError, WebSocketDisconnect):
                await socket.close(1008, viewer.reason)

    async def _receive(self, socket: WebSocket, viewer: Viewer) -> None:
        # Read until it leaves, or sends a message that no page of ours would.
        times: deque[float] = deque(maxlen=_MOST_MESSAGES_A_S)
        while True:
            try:
                message = json.loads(await socket.receive_text())
                self._obey(viewer, message)
                if message["type"] != "time":  # each sends all that is known, and may have pictures made anew
                    await asyncio.sleep(WATCH_PAUSE_S)
            except (WebSocketDisconnect, RuntimeError, LookupError, TypeError, ValueError, ArithmeticError):
                return
            now_s = time.monotonic()
            if len(times) == times.maxlen and now_s - times[0] < 1:
                return
            times.append(now_s)

    def _obey(self, viewer: Viewer, message: dict[str, Any]) -> None:
        # Raises `ValueError` and the like for anything but a message.
        match message["type"]:
            case "watch":
                edge = message["edge"]
                if message["rung"] not in RUNGS or not isinstance(edge, str):
                    raise ValueError("no rung")
                self._hub.watch(viewer, edge, message["rung"])
            case "wall":
                self._hub.show_wall(viewer, shown=message["shown"] is True)
            case "time":
                viewer.put(text("time", sent=float(message["sent"]), now=self._now_ms()))
            case _:
                raise ValueError("no message")

    def _now_ms(self) -> float:
        return round(self._clock() / 1e6, 1)


async def _send(socket: WebSocket, viewer: Viewer) -> None:
    # Send the queue as fast as it is taken; one that takes nothing is closed for want of an answer to a ping.
    with suppress(WebSocketDisconnect, RuntimeError, ConnectionError):
        while True:
            message = await viewer.take()
            kind = "text" if isinstance(message, str) else "bytes"
            await socket.send({"type": "websocket.send", kind: message})


async def _json_body(request: Request) -> dict[str, Any]:
    body = b""
    try:
        async with asyncio.timeout(5):
            async for chunk in request.stream():
                body += chunk
                if len(body) > MOST_MESSAGE_BYTES:
                    raise BadRequestError("too much was sent")
        found = json.loads(body or b"{}")
    except (ValueError, RecursionError, TimeoutError, ClientDisconnect):
        raise BadRequestError("this is no JSON") from None
    if not isinstance(found, dict):
        raise BadRequestError("this is no JSON object")
    return found


async def _refusal(_: Request, error: Exception) -> Response:
    status = 400 if isinstance(error, BadRequestError) else 429 if isinstance(error, BusyError) else 409
    return PlainTextResponse(str(error), status)


def _file(name: str) -> Response:
    if name not in _FILES:
        return PlainTextResponse("there is nothing here", 404)
    data, media_type = _FILES[name]
    return Response(data, media_type=media_type)


class _Guard:
    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app = app
        self._access = access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        async def guarded(message: Any) -> None:
            if message["type"].endswith("http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        refusal = self._refusal(scope)
        if refusal is None:
            await self._app(scope, receive, guarded)
        elif scope["type"] == "http":
            await refusal(scope, receive, guarded)
        else:
            await WebSocket(scope, receive, guarded).send_denial_response(refusal)

    def _refusal(self, scope: Scope) -> Response | None:
        said = Headers(scope=scope)
        headers = {name: ", ".join(said.getlist(name)) for name in said}  # as RFC 9110, 5.3, has it
        token = None
        if scope["type"] == "http" and scope["path"] == "/":
            token = Request(scope).query_params.get("token")
        role = self._access.role(headers, token=token)
        if role is None:
            return PlainTextResponse(*self._access.refusal)
        scope["role"] = role
        acts = scope["type"] == "websocket" or scope["method"] not in ("GET", "HEAD")
        if acts and (foreign := self._access.foreign(headers)):
            return PlainTextResponse(foreign, 403)
        if acts and scope["type"] == "http" and role != "operator" and scope["path"] != _SOCKET:
            return PlainTextResponse("only an operator may do this", 403)
        return None


def make_site(
    access: Access, hub: Hub, edge_requests: EdgeRequests, *, clock: Callable[[], int]
) -> Callable[..., Any]:
    """The ASGI application; ``clock`` is the ground's, Unix nanoseconds."""
    site = Site(access, hub, edge_requests, clock)
    routes = [
        Route("/", site.index),
        Route("/static/{name}", site.file),
        Route("/stills/{edge}/{still}/{which}", site.still),
        Route("/edges/{edge}/still", site.request_still, methods=["POST"]),
        Route("/edges/{edge}/keyframe", site.keyframe, methods=["POST"]),
        Route("/edges/{edge}/settings", site.settings, methods=["POST"]),
        WebSocketRoute(_SOCKET, site.socket),
        Route(_SOCKET, site.admits, methods=["POST"]),
    ]
    return _Guard(Starlette(routes=routes, exception_handlers={UserError: _refusal}), access)
