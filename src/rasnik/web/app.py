"""The page, the websocket and the HTTP interface put together."""

from __future__ import annotations

import asyncio
import urllib.parse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles

from rasnik.web.api import ENDPOINTS, ApiError, Bytes, Endpoint, answer, body_of
from rasnik.web.feed import Feeds
from rasnik.web.guard import Guard, cookie_of, same_token
from rasnik.web.openapi import document

if TYPE_CHECKING:
    from rasnik.live.service import Station

__all__ = ["create_app"]

_STATIC = Path(__file__).parent / "static"
_COOKIE_S = 30 * 24 * 3600
_WRONG_TOKEN = '<p role="alert">This is not the token.</p>'
_WRONG_TOKEN_S = 0.5  # an answer to a wrong token takes as long


def create_app(station: Station, *, token: str | None = None) -> Starlette:
    """The application that serves a station.

    Parameters
    ----------
    station : Station
    token : str, optional
        Then every request needs it. Without one, only this machine is answered.
    """
    feeds = Feeds(station)
    description = document()

    async def describe(request: Request) -> Response:
        return JSONResponse(description)

    routes: list[BaseRoute] = [_route(endpoint, station) for endpoint in ENDPOINTS]
    routes += [
        Route("/api/openapi.json", describe),
        WebSocketRoute("/ws", feeds.serve),
        Route("/", _file("index.html")),
        Mount("/static", StaticFiles(directory=_STATIC)),
    ]
    if token is not None:
        routes += [Route("/login", _file("login.html"), methods=["GET"]), _login(token)]
        routes.append(Route("/login.css", _file("login.css")))
    return Starlette(
        routes=routes,
        middleware=[Middleware(Guard, token=token)],
        exception_handlers={HTTPException: _http_error, ApiError: _api_error},
    )


def _route(endpoint: Endpoint, station: Station) -> Route:
    async def handle(request: Request) -> Response:
        given: dict[str, Any] = dict(request.query_params)
        if endpoint.method == "POST":
            given = body_of(await request.body())
        name = request.path_params.get("name")
        found = await run_in_threadpool(answer, endpoint, station, name, given)
        if isinstance(found, Bytes):
            return Response(found.content, media_type=found.media_type)
        return JSONResponse(found)

    return Route(endpoint.path, handle, methods=[endpoint.method])


def _file(name: str) -> Any:
    async def send(request: Request) -> Response:
        return FileResponse(_STATIC / name)

    return send


def _login(token: str) -> Route:
    """Takes the token from the form and gives a cookie."""

    page = (_STATIC / "login.html").read_text(encoding="utf-8")

    async def login(request: Request) -> Response:
        form = urllib.parse.parse_qs((await request.body()).decode("utf-8", "replace"))
        if not same_token(form.get("token", [""])[0].strip(), token):
            await asyncio.sleep(_WRONG_TOKEN_S)
            return HTMLResponse(page.replace("<!-- what is wrong -->", _WRONG_TOKEN), 401)
        response = RedirectResponse("/", 303)
        response.set_cookie(*cookie_of(token), max_age=_COOKIE_S, httponly=True, samesite="strict")
        return response

    return Route("/login", login, methods=["POST"])


async def _http_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, HTTPException)
    sentences = {404: "There is nothing at this address.", 405: "This cannot be done here."}
    sentence = sentences.get(error.status_code, str(error.detail))
    return JSONResponse({"error": sentence}, error.status_code, error.headers)


async def _api_error(request: Request, error: Exception) -> Response:
    assert isinstance(error, ApiError)
    return JSONResponse({"error": str(error)}, error.status)
