"""Edge. Where the stand-ins listen: bound by the supervisor, so that nobody else can have the place meanwhile."""

import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from ccatp.config.models import Config
from ccatp.errors import ConfigError


@contextmanager
def listen(section: str, host: str, port: int) -> Iterator[socket.socket]:
    """A listening socket for a process that inherits it.

    Args:
        section: of the configuration that names the address.
        host, port: the address; port 0 takes any that is free.

    Raises:
        ConfigError: the port is taken.
    """
    with socket.socket() as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, port))
        except OSError as error:
            raise ConfigError(
                f"{section}.port: cannot listen on {host}:{port}: {error.strerror}; "
                f"stop who uses it, or choose another with --set {section}.port=0 (0 = any free port)"
            ) from error
        listener.listen(16)
        yield listener


def places_of(cfg: Config) -> dict[str, tuple[str, int]]:
    """Where the stand-ins shall listen, (host, port) by the section of the configuration."""
    robot, etalon = cfg.sim.robot, cfg.sim.etalon
    return {"sim.robot": (robot.host, robot.port), "sim.etalon": (etalon.host, etalon.port)}


def with_addresses(cfg: Config, sockets: Mapping[str, socket.socket]) -> Config:
    """The configuration with the addresses at which the stand-ins really listen."""

    def at(process: str) -> dict[str, object]:
        host, port = sockets[process].getsockname()
        return {"host": host, "port": port}

    robot, etalon = at("dataloop"), at("etalon")
    sim = {
        "robot": cfg.sim.robot.model_copy(update=robot),
        "etalon": cfg.sim.etalon.model_copy(update=etalon),
    }
    return cfg.model_copy(
        update={
            "robot": cfg.robot.model_copy(update=robot),
            "etalon": cfg.etalon.model_copy(update=etalon),
            "sim": cfg.sim.model_copy(update=sim),
        }
    )
