"""The server of the live page: loopback only, for pages of its own origin that know the token of the link."""

from __future__ import annotations

import asyncio
import json
import secrets
import socket
from collections.abc import Coroutine
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import uvicorn
from starlette.applications import Starlette
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from salient.view.commands import Commander, Malformed, check_command
from salient.view.frames import FrameStore
from salient.view.link import SHOWN_WITHIN_NS, Link
from salient.view.traffic_feed import TrafficFeed

PAGE = Path(__file__).parent / "page"
LOOK = Path(__file__).parents[1] / "pages" / "look.css"
_TYPES = {".html": "text/html", ".js": "text/javascript", ".css": "text/css", ".svg": "image/svg+xml"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
                               "frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Cache-Control": "no-store", "Referrer-Policy": "no-referrer", "X-Content-Type-Options": "nosniff",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_TEXT_BYTES_MAX = 65_536
PAGES_MAX = 32
_TOO_MANY = f"{PAGES_MAX} pages are open, and there are no more than that: close one"
_TRY_LATER = 1013  # of RFC 6455's registry
_POLL_S = 0.004
_LOG_REFUSES = "a log takes no commands"


class Feed(Protocol):
    """Where the frames of the pages come from: a bus or a log."""

    info: dict[str, Any]
    store: FrameStore
    traffic: TrafficFeed

    @property
    def link(self) -> Link | None:
        """The bus that takes commands."""

    @property
    def ended(self) -> str:
        """Why there will be no more frames; empty while there may be."""

    def first_number(self) -> int:
        """The number of the first frame that a new page is sent."""


class _Page:
    """One open page."""

    def __init__(self, websocket: WebSocket, number: int) -> None:
        self.websocket, self.number = websocket, number
        self.wants_frames = asyncio.Event()
        self.shown_ns = 0.0
        self.has_slept = False


class Server:
    """Serves the pages of one feed. token: part of the link, without which a request is refused."""

    def __init__(self, feed: Feed) -> None:
        self.feed = feed
        self.token = secrets.token_urlsafe(18)
        self.malformed = 0
        self._files = {path.relative_to(PAGE).as_posix(): path for path in PAGE.rglob("*") if path.suffix in _TYPES}
        self._files[LOOK.name] = LOOK
        self._commander = Commander(feed.link) if feed.link else None
        self._leaseholder: _Page | None = None
        self._pages: list[_Page] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._socket = socket.socket()
        self._socket.bind(("127.0.0.1", 0))
        self._socket.listen()  # the link is valid as soon as it is printed
        self._port = self._socket.getsockname()[1]
        self.application = Starlette(routes=[WebSocketRoute("/frames", self._serve), Route("/", self._index),
                                             Route("/{path:path}", self._file)])

    @property
    def link(self) -> str:
        """Address that the user opens."""
        return f"http://127.0.0.1:{self._port}/?token={self.token}"

    def run(self) -> None:
        """Serves until an interrupt."""
        config = uvicorn.Config(self.application, log_level="error", ws="websockets-sansio",
                                ws_max_size=_TEXT_BYTES_MAX, ws_per_message_deflate=False, lifespan="off")
        with suppress(KeyboardInterrupt):
            uvicorn.Server(config).run(sockets=[self._socket])

    # --- files -----------------------------------------------------------------------------------------------------

    def _hosts(self) -> tuple[str, str]:
        return f"127.0.0.1:{self._port}", f"localhost:{self._port}"

    async def _index(self, request: Request) -> Response:
        if request.headers.get("host") not in self._hosts() or not self._knows_token(request.query_params):
            return PlainTextResponse("Open the link that tools/salient view has printed.", 403, headers=_HEADERS)
        return FileResponse(PAGE / "index.html", headers=_HEADERS)

    async def _file(self, request: Request) -> Response:
        path = self._files.get(request.path_params["path"])  # no name of a request reaches the file system
        if request.headers.get("host") not in self._hosts():
            return PlainTextResponse("", 403, headers=_HEADERS)
        if path is None:
            return PlainTextResponse("no such file", 404, headers=_HEADERS)
        return FileResponse(path, media_type=_TYPES[path.suffix], headers=_HEADERS)

    def _knows_token(self, parameters: Any) -> bool:
        return secrets.compare_digest(parameters.get("token", "").encode(), self.token.encode())

    # --- pages -----------------------------------------------------------------------------------------------------

    async def _serve(self, websocket: WebSocket) -> None:
        own = websocket.headers.get("origin") in {f"http://{host}" for host in self._hosts()}
        if not own or websocket.headers.get("host") not in self._hosts() or not self._knows_token(
                websocket.query_params):
            await websocket.close(1008)  # before it is accepted: an answer 403 without content
            return
        if len(self._pages) >= PAGES_MAX:
            await websocket.accept()  # else the page would not be told why
            await websocket.close(_TRY_LATER, _TOO_MANY)
            return
        page = _Page(websocket, self.feed.first_number())
        self._pages.append(page)
        tasks: list[asyncio.Task[None]] = []
        try:
            await websocket.accept()
            await self._attend(page, tasks)
        except (WebSocketDisconnect, RuntimeError):
            pass  # closed by the page, at any moment
        finally:
            for task in tasks:
                task.cancel()
            self._pages.remove(page)
            self._release(page)

    async def _attend(self, page: _Page, tasks: list[asyncio.Task[None]]) -> None:
        tasks += [asyncio.create_task(task) for task in (self._send_frames(page), self._send_notices(page))]
        await page.websocket.send_text(json.dumps({"info": self.feed.info}))
        await self._take_messages(page)

    async def _take_messages(self, page: _Page) -> None:
        while True:
            event = await page.websocket.receive()
            if event["type"] == "websocket.disconnect":
                return
            try:
                self._take_message(page, event.get("text"))
            except Malformed:
                self.malformed += 1

    def _take_message(self, page: _Page, text: str | None) -> None:
        try:
            message = json.loads(text or "", parse_constant=_refuse)
        except (ValueError, RecursionError):
            raise Malformed from None
        if not isinstance(message, dict):
            raise Malformed
        if message.keys() == {"shown"}:
            self._take_shown(page, message["shown"])
        elif message.keys() == {"n", "name", "args"} and type(message["n"]) is int:
            if message["name"] in ("take", "release") and message["args"] == {}:
                answer = self._take(page) if message["name"] == "take" else self._release(page)
                self._begin(self._answer(page, message["n"], answer))
                return
            check_command(message["name"], message["args"])
            self._begin(self._command(page, message["n"], message["name"], message["args"]))
        else:
            raise Malformed

    def _take_shown(self, page: _Page, shown_ns: Any) -> None:
        if not isinstance(shown_ns, int | float) or isinstance(shown_ns, bool) or not 0 <= shown_ns < 2**63:
            raise Malformed
        page.shown_ns = float(shown_ns)
        page.wants_frames.set()
        if page is self._leaseholder and self.feed.link is not None:
            self.feed.link.take_shown(round(page.shown_ns))

    def _begin(self, task: Coroutine[Any, Any, None]) -> None:
        running = asyncio.create_task(task)
        self._tasks.add(running)
        running.add_done_callback(self._tasks.discard)

    async def _command(self, page: _Page, number: int, name: str, arguments: dict[str, Any]) -> None:
        commander, link = self._commander, self.feed.link
        if commander is None or link is None:
            answer = {"ok": False, "message": _LOG_REFUSES}
        elif page is not self._leaseholder:
            answer = {"ok": False, "message": "this page does not command: take command first"}
        else:
            try:
                answer = await asyncio.wrap_future(link.call(partial(commander.execute, name, arguments)))
            except Exception as error:  # whatever it is, the page is told
                answer = {"ok": False, "message": str(error)}
        await self._answer(page, number, answer)

    async def _answer(self, page: _Page, number: int, answer: dict[str, Any]) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):
            await page.websocket.send_text(json.dumps({"n": number, **answer}))

    # --- the lease of the commanding page --------------------------------------------------------------------------

    def _take(self, page: _Page) -> dict[str, Any]:
        link = self.feed.link
        if link is None:
            return {"ok": False, "message": _LOG_REFUSES}
        if self._leaseholder is page:
            return {"ok": True, "message": ""}
        if self._leaseholder is not None:
            return {"ok": False, "message": "another page commands this drive: release or close it there first"}
        self._leaseholder, page.has_slept = page, False
        link.take_shown(round(page.shown_ns))
        return {"ok": True, "message": ""}

    def _release(self, page: _Page) -> dict[str, Any]:
        """Without the page's repeated command the drive stops by its command timeout."""
        if self._leaseholder is page and self.feed.link is not None:
            self._leaseholder = None
            self.feed.link.shown_ns = None
        return {"ok": True, "message": ""}

    def _end_sleepers_lease(self) -> None:
        page, link = self._leaseholder, self.feed.link
        if page is not None and link is not None and link.time_ns - (link.shown_ns or 0) > SHOWN_WITHIN_NS:
            self._release(page)
            page.has_slept = True

    # --- what a page is told ---------------------------------------------------------------------------------------

    async def _send_frames(self, page: _Page) -> None:
        """One message per display frame of the page, with all frames since the last."""
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                await page.wants_frames.wait()
                page.wants_frames.clear()
                while (found := self.feed.store.message_from(page.number)) is None:
                    await asyncio.sleep(_POLL_S)
                page.number, message = found
                await page.websocket.send_bytes(message)

    async def _send_notices(self, page: _Page) -> None:
        sent: dict[str, Any] = {}
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                self._end_sleepers_lease()
                notice = self._notice(page)
                changed = {key: value for key, value in notice.items() if sent.get(key) != value}
                if changed:
                    await page.websocket.send_text(json.dumps({"notice": changed}))
                    sent = notice
                await asyncio.sleep(10 * _POLL_S)

    def _notice(self, page: _Page) -> dict[str, Any]:
        holder = self._leaseholder
        notice: dict[str, Any] = {
            "lease": "yours" if holder is page else "free" if holder is None else "other",
            "malformed": self.malformed,
            "text": "",
            "traffic": self.feed.traffic.state,
        }
        if page.has_slept:
            notice["text"] = "command was released: this page slept, and the drive stops by its command timeout"
        if self.feed.ended and page.number >= self.feed.store.next_number:
            notice |= {"ended": True, "text": self.feed.ended}
        return notice


def _refuse(_: str) -> None:
    raise Malformed
