"""Edge. Request and reply over TCP: a ROUTER with CURVE keys, and the ZAP handler that decides who gets in.

It fails closed. libzmq lets anybody in who knows the server's key while no ZAP handler is bound, unless
``ZAP_ENFORCE_DOMAIN`` is set; with it, no handler and a handler that does not answer both mean that nobody gets in.
"""

from collections.abc import Awaitable, Callable
from types import TracebackType
from typing import Self

import zmq
import zmq.asyncio

from ccatp.curve_keys import KeyPair
from ccatp.router import Router, RouterError
from ccatp.wire.access import Clients, answer_zap

ZAP_ENDPOINT = "inproc://zeromq.zap.01"
DOMAIN = "ccatp.observatory"
# A peer that is gone without a word gives its place back.
HEARTBEAT_MS, HEARTBEAT_TIMEOUT_MS = 5000, 15000

NamedHandler = Callable[[bytes, str], bytes | Awaitable[bytes]]


class ZapHandler:
    """Decides which CURVE keys get in.

    Use as an async context manager around ``serve``, and enter it before the ``CurveRouter`` of the same context.

    Args:
        context: ZeroMQ context of the process; there can be one handler in it.
        clients: who is listed at the moment.
        on_refused: told why somebody was not let in.
    """

    def __init__(
        self, context: zmq.asyncio.Context, clients: Callable[[], Clients], on_refused: Callable[[str], None]
    ) -> None:
        self._context, self._clients, self._on_refused = context, clients, on_refused
        self._socket: zmq.asyncio.Socket | None = None

    async def __aenter__(self) -> Self:
        """Bind."""
        socket = self._context.socket(zmq.REP)
        socket.setsockopt(zmq.LINGER, 0)
        socket.bind(ZAP_ENDPOINT)
        self._socket = socket
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close: from here on nobody gets in."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def serve(self) -> None:
        """Answer libzmq until cancelled."""
        while self._socket is not None:
            reply, refusal = answer_zap(await self._socket.recv_multipart(), DOMAIN, self._clients())
            if refusal:
                self._on_refused(refusal)
            await self._socket.send_multipart(reply)


class CurveRouter(Router):
    """As ``Router``, on ``tcp://`` for CURVE clients that a ``ZapHandler`` admits.

    Args:
        endpoint: ``tcp://ADDRESS:PORT``.
        handler: what answers; called with the request and the client's key in hexadecimal.
        context: ZeroMQ context of the process.
        keys: the server's pair.
    """

    def __init__(self, endpoint: str, handler: NamedHandler, context: zmq.asyncio.Context, keys: KeyPair) -> None:
        super().__init__(endpoint, lambda _: b"", context)
        self._named_handler, self._keys = handler, keys

    def _check_endpoint(self) -> None:
        if not self._endpoint.startswith("tcp://"):
            raise RouterError(f"{self._endpoint}: CURVE keys are for tcp://")

    def _configure(self, router: zmq.asyncio.Socket) -> None:
        super()._configure(router)
        router.setsockopt(zmq.ZAP_DOMAIN, DOMAIN.encode())
        router.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        router.setsockopt(zmq.CURVE_SERVER, 1)
        router.setsockopt(zmq.CURVE_PUBLICKEY, self._keys.public)
        router.setsockopt(zmq.CURVE_SECRETKEY, self._keys.secret)
        router.setsockopt(zmq.HEARTBEAT_IVL, HEARTBEAT_MS)
        router.setsockopt(zmq.HEARTBEAT_TIMEOUT, HEARTBEAT_TIMEOUT_MS)
        router.setsockopt(zmq.TCP_KEEPALIVE, 1)

    async def _receive(self, router: zmq.asyncio.Socket) -> tuple[list[bytes], str]:
        frames = await router.recv_multipart(copy=False)
        return [frame.bytes for frame in frames], str(frames[-1].get("User-Id"))

    def _ask(self, payload: bytes, user_id: str) -> bytes | Awaitable[bytes]:
        return self._named_handler(payload, user_id)
