"""A daemon's channel in a thread: a real ROUTER that answers as a test wants."""

import asyncio
import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import zmq.asyncio

from ccatp.links.rpc import Router

Answer = Callable[[dict[str, Any]], dict[str, Any]]


@contextmanager
def serving(folder: Path, channel: str, answer: Answer) -> Iterator[list[dict[str, Any]]]:
    """A real ROUTER in a thread of its own; yields what it was asked."""
    asked: list[dict[str, Any]] = []
    ready, loop = threading.Event(), asyncio.new_event_loop()

    def handle(frame: bytes) -> bytes:
        asked.append(json.loads(frame))
        return json.dumps(answer(asked[-1])).encode()

    async def serve() -> None:
        context = zmq.asyncio.Context()
        try:
            async with Router(f"ipc://{folder / channel}", handle, context) as router:
                ready.set()
                await router.serve()
        finally:
            context.destroy(linger=0)

    task = loop.create_task(serve())

    def run() -> None:
        try:
            loop.run_until_complete(task)
        except asyncio.CancelledError:
            pass
        finally:
            loop.close()

    thread = threading.Thread(target=run)
    thread.start()
    assert ready.wait(10.0)
    try:
        yield asked
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join()
