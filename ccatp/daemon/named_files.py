"""Files that a configuration names and the processes of a run read: keys, list of clients, tokens."""

from collections.abc import Iterator
from pathlib import Path

from ccatp.config.beacon_models import RadioConfig
from ccatp.config.files import read_key
from ccatp.config.models import Config
from ccatp.daemon.command_handlers import CLIENTS_FILE, KEY_FILE, check_observatory
from ccatp.report.dashboard.access import read_tokens


def check_named_files(cfg: Config | RadioConfig, *, is_sim: bool) -> None:
    """Read them all once. ConfigError: the first that cannot be used; ``is_sim``: the robot's key is no secret."""
    check_observatory(cfg.observatory)
    read_key(cfg.robot.key_file, must_be_private=not is_sim)
    if cfg.dashboard.token_file:
        read_tokens(Path(cfg.dashboard.token_file))


def missing_files(cfg: Config | RadioConfig) -> Iterator[str]:
    """The keys of the configuration whose file does not exist, with the file: it may be on another machine."""
    observatory = cfg.observatory
    named = [("robot.key_file", cfg.robot.key_file), ("dashboard.token_file", cfg.dashboard.token_file)]
    if observatory.endpoint:
        named += [(KEY_FILE, observatory.key_file), (CLIENTS_FILE, observatory.clients_file)]
    for key, file in named:
        if file and not Path(file).exists():
            yield f"{key}: {file} does not exist on this machine"
