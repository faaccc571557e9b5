"""Who may talk to the page: a browser that was given the address with its token, and no other page in that browser."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from aiohttp.web import Request, StreamResponse

LOCAL = ("127.0.0.1", "localhost", "[::1]")
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; worker-src 'self' blob:; connect-src 'self' ws: wss:; "
    "frame-ancestors 'none'; form-action 'none'; base-uri 'self'"
)


class Guard:
    """Refuses requests with another Host or Origin, or without the token.

    The token comes in the address, `?token=...`, and then in a cookie that no other site's page can send.

    Args:
        host: that the server listens on; addresses of this machine itself have several names.
    """

    def __init__(self, host: str) -> None:
        self.token = secrets.token_urlsafe(24)
        self._host = host
        self.port = 0

    @property
    def hosts(self) -> set[str]:
        """What a Host header may be."""
        names = LOCAL if self._host in LOCAL else (self._host,)
        return {f"{name}:{self.port}" for name in names}

    @property
    def cookie(self) -> str:
        """The name of the cookie: browsers send cookies to all ports of a machine."""
        return f"rbfevo-studio-{self.port}"

    def refusal(self, request: Request) -> str | None:
        """Why a request is refused, or None."""
        if self.port == 0:
            self.port = request.transport.get_extra_info("sockname")[1] if request.transport else 0
        if self._host not in ("0.0.0.0", "::") and request.headers.get("Host") not in self.hosts:
            return "another host"
        origin = request.headers.get("Origin")
        if origin is not None and origin != f"http://{request.headers.get('Host')}":
            return "another origin"
        if origin is None and request.headers.get("Upgrade", "").lower() == "websocket":
            return "no origin"
        given = request.query.get("token") or request.cookies.get(self.cookie, "")
        if not hmac.compare_digest(given.encode(), self.token.encode()):
            return "no token, or a wrong one: open the address that the program has printed"
        return None

    def middleware(
        self,
    ) -> Callable[[Request, Callable[[Request], Awaitable[StreamResponse]]], Awaitable[StreamResponse]]:
        """For an application of aiohttp."""
        from aiohttp import web

        @web.middleware
        async def guard(request: Request, handler: Callable[[Request], Awaitable[StreamResponse]]) -> StreamResponse:
            """Answer 403 to what is refused; let the token come by a cookie from now on."""
            reason = self.refusal(request)
            if reason is not None:
                return web.Response(status=403, text=f"403: {reason}\n")
            response = await handler(request)
            if not response.prepared:
                response.headers["Content-Security-Policy"] = POLICY
                response.headers["X-Content-Type-Options"] = "nosniff"
                response.headers["Referrer-Policy"] = "no-referrer"
                if request.query.get("token"):
                    response.set_cookie(self.cookie, self.token, httponly=True, samesite="Strict", path="/")
            return response

        return guard
