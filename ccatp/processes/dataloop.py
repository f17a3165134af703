"""Glue. The DataLoop's process: the robot's stand-in behind the robot link."""

import asyncio
import socket
import sys

from ccatp.config.models import Config
from ccatp.dataloop import serve
from ccatp.processes.common import die_with_parent, open_log, parse_args, stop_on_signals


def main() -> int:
    """Entry of ``python -m ccatp.processes.dataloop``."""
    die_with_parent()
    args = parse_args()
    log = open_log(args.run_dir / "log.jsonl", "dataloop")

    async def run() -> None:
        stop = asyncio.Event()
        stop_on_signals(stop)
        await serve(
            args.config,
            lockstep=not args.is_realtime,
            seed=args.config.run.seed,
            listen_sock=socket.socket(fileno=args.listen_fd),
            truth_rep=args.endpoints.of("puck"),
            truth_pub=args.endpoints.of("truth"),
            stop=stop,
            log=log,
        )

    asyncio.run(run())
    return 0


def run_alone(cfg: Config, lockstep: bool) -> int:
    """The stand-in alone, for other people's controllers; ends on SIGINT or SIGTERM."""
    raise SystemExit("todo")


if __name__ == "__main__":
    sys.exit(main())
