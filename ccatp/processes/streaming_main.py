"""Glue. ``ccatp stream`` from its options to its end."""

import os
import signal
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

import zmq

from ccatp.live_streams import FoxgloveStream, PlotJugglerStream, Stream, check_host
from ccatp.processes.streaming import Streamer, streamed_schemas
from ccatp.runtime_dir import runtime_dir_path

NICENESS = 10


def serve(
    runtime_dir: Path | None,
    host: str,
    plotjuggler_port: int | None,
    foxglove_port: int | None,
    *,
    is_open: bool,
    say: Callable[[str], None],
) -> int:
    """Stream until SIGINT or SIGTERM.

    Args:
        runtime_dir: of the runs, if not the usual one.
        host: where to listen.
        plotjuggler_port, foxglove_port: 0 takes any free one, ``None`` serves none.
        is_open: the host may be another one than this machine.
        say: tells the user.

    Raises:
        StreamError: something cannot be served.
    """
    check_host(host, is_open=is_open)
    folder = runtime_dir_path(str(runtime_dir or ""), os.environ)
    is_over = False

    def end(_number: int, _frame: FrameType | None) -> None:
        nonlocal is_over
        is_over = True

    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        streams: list[Stream] = []
        for stream in _streams(context, host, plotjuggler_port, foxglove_port):
            stack.callback(stream.close)
            streams.append(stream)
            say(f"serving at {stream.where}")
        streamer = Streamer(context, folder, streams, say)
        stack.callback(streamer.close)
        for number in (signal.SIGINT, signal.SIGTERM):
            stack.callback(signal.signal, number, signal.signal(number, end))
        os.nice(NICENESS)
        say(f"waiting for a run in {folder}")
        while not is_over:
            streamer.step()
    return 0


def _streams(
    context: "zmq.Context[zmq.Socket[bytes]]", host: str, plotjuggler_port: int | None, foxglove_port: int | None
) -> "list[Stream]":
    found: list[Stream] = []
    if plotjuggler_port is not None:
        found.append(PlotJugglerStream(context, host, plotjuggler_port))
    if foxglove_port is not None:
        found.append(FoxgloveStream("ccatp", host, foxglove_port, streamed_schemas()))
    return found
