"""Both ends of a TCP connection: a server that follows a script, and a client that talks lines."""

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager

DEADLINE_S = 5.0  # what takes milliseconds in a good run may take this long on a loaded machine

Script = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def scripted(script: Script, port: int = 0) -> AsyncIterator[int]:
    """A server that runs a script for each client; at the end of the script the connection ends. Yields its port."""
    running: set[asyncio.Task[None]] = set()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        running.add(task)
        try:
            await script(reader, writer)
        except ConnectionError:
            pass
        except asyncio.CancelledError:
            writer.transport.abort()
        finally:
            running.discard(task)
            writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", port)
    try:
        yield server.sockets[0].getsockname()[1]
    finally:
        server.close()
        ending = [*running]
        for task in ending:
            task.cancel()
        await asyncio.gather(*ending, return_exceptions=True)
        await server.wait_closed()


class Peer:
    """A plain socket that talks lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    async def line(self) -> bytes:
        """The next line; empty at the end."""
        async with asyncio.timeout(DEADLINE_S):
            try:
                return await self.reader.readline()
            except ConnectionError:
                return b""

    async def ask(self, line: bytes) -> bytes:
        """The line that comes after one is sent."""
        self.writer.write(line)
        return await self.line()

    async def is_closed(self) -> bool:
        """Whether the other side closes, whatever it says before."""
        while await self.line():
            pass
        return True


@asynccontextmanager
async def peer_of(port: int) -> AsyncIterator[Peer]:
    """A client of a server of this machine."""
    peer = Peer(*await asyncio.open_connection("127.0.0.1", port))
    try:
        yield peer
    finally:
        peer.writer.transport.abort()
