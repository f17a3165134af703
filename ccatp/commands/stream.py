"""Glue. The command ``ccatp stream``."""

import os
from pathlib import Path

import click

from ccatp.commands.frame import CONFIG_OPTION, RUNTIME_DIR_OPTION, configured_folder, example

PLOTJUGGLER_PORT = 9872
FOXGLOVE_PORT = 8765


@click.command(
    epilog=example("ccatp stream", "ccatp stream --foxglove", "ccatp stream --no-plotjuggler --foxglove-port 8800")
)
@CONFIG_OPTION
@RUNTIME_DIR_OPTION
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option("--plotjuggler/--no-plotjuggler", default=True, show_default=True, help="Serve PlotJuggler's ZMQ plugin.")
@click.option("--port", type=click.IntRange(0, 65535), default=PLOTJUGGLER_PORT, show_default=True, help="Its port.")
@click.option("--foxglove", is_flag=True, help="Serve Foxglove and Lichtblick by WebSocket (extra foxglove).")
@click.option(
    "--foxglove-port",
    type=click.IntRange(0, 65535),
    help=f"Its port, else {FOXGLOVE_PORT}; implies --foxglove.",
)
@click.option("--open-to-network", is_flag=True, help="Let --host be another address than this machine's own.")
def stream(
    config_file: Path | None, runtime_dir: Path | None, host: str, plotjuggler: bool, port: int,
    foxglove: bool, foxglove_port: int | None, open_to_network: bool,
) -> int:  # fmt: skip
    """Stream the runs on this machine live to PlotJuggler and Foxglove, until interrupted.

    It may be started and ended at any time; runs do not notice. A viewer that comes late gets the panels' map at once.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from ccatp.processes.streaming_main import serve

    foxglove_port = FOXGLOVE_PORT if foxglove and foxglove_port is None else foxglove_port
    if not plotjuggler and foxglove_port is None:
        raise click.UsageError("nothing to serve: leave out --no-plotjuggler, or add --foxglove")
    return serve(
        configured_folder(config_file, runtime_dir),
        host,
        port if plotjuggler else None,
        foxglove_port,
        is_open=open_to_network,
        say=lambda text: click.echo(f"ccatp stream: {text}", err=True),
    )
