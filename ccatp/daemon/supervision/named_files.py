"""Files that a configuration names and the processes of a run read: keys, list of clients, tokens."""

from collections.abc import Callable, Iterator
from pathlib import Path

from ccatp.config.files import read_key
from ccatp.config.mission import CommonConfig
from ccatp.daemon.operator.observatory import CLIENTS_FILE, KEY_FILE
from ccatp.errors import ConfigError
from ccatp.links.auth import read_clients, read_pair
from ccatp.report.dashboard.access import read_tokens


def check_named_files(cfg: CommonConfig, *, is_sim: bool) -> None:
    """Read them all once. ConfigError: one line for each that cannot be used.

    ``is_sim``: the key of the robot is no secret.
    """
    problems: list[str] = []
    for read in _readers(cfg, is_sim=is_sim):
        try:
            read()
        except ConfigError as error:
            problems += error.problems
    if problems:
        raise ConfigError(*problems)


def _readers(cfg: CommonConfig, *, is_sim: bool) -> Iterator[Callable[[], object]]:
    observatory, token_file = cfg.observatory, cfg.dashboard.token_file
    if observatory.endpoint:
        yield lambda: read_clients(Path(observatory.clients_file), CLIENTS_FILE)
        yield lambda: read_pair(Path(observatory.key_file), KEY_FILE)
    yield lambda: read_key(cfg.robot.key_file, must_be_private=not is_sim)
    if token_file:
        yield lambda: read_tokens(Path(token_file))
