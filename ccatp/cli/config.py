"""``ccatp config``, ``ccatp keys``, ``ccatp completion``."""

import json
import re
import shutil
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from ccatp.cli import common
from ccatp.errors import ConfigError


@click.group(
    cls=common.CommandGroup,
    epilog=common.example("ccatp config check telescope.toml", "ccatp config schema > ccatp.schema.json"),
)
def config() -> None:
    """Check and describe configurations."""


@config.command("check", epilog=common.example("ccatp config check telescope.toml"))
@click.argument("file", type=common.CONFIG_FILE)
def config_check(file: Path) -> int:
    """Check a configuration and the files that it names; each problem is one line with its key.

    Check it on the machine where it will be used, because keys and tokens are files of this machine.
    """
    from ccatp.config.load import load_mission
    from ccatp.daemon.supervision.named_files import check_named_files
    from ccatp.missions import kind_of

    try:
        cfg = load_mission(file)
        check_named_files(cfg, is_sim=True)  # without a robot it is not known whether its key is a secret
    except ConfigError as error:
        for problem in error.problems:
            common.complain(problem, error.exit_status)
        return error.exit_status
    kind = kind_of(cfg)
    text = kind.text.get()(cfg)
    if kind.without_effect is not None:
        common.warn(f"{file}: {line}" for line in kind.without_effect.get()(cfg, True))  # likewise
    click.echo(f"{file}: ok: {text.shown}, seed {cfg.run.seed}")
    return 0


@config.command("schema", epilog=common.example("ccatp config schema > ccatp.schema.json"))
def config_schema() -> None:
    """Print the JSON schema of a configuration file: every key with its meaning, type, limits and unit."""
    from ccatp.config.describe import json_schema

    click.echo(json.dumps(json_schema(), indent=2))


@config.command("init", epilog=common.example("ccatp config init telescope.toml"))
@click.argument("file", type=common.PATH)
@click.option("--force", is_flag=True, help="Replace the file that is there.")
def config_init(file: Path, force: bool) -> None:
    """Write a configuration to begin with: every key with its default and its meaning, commented out."""
    from ccatp.config.describe import template
    from ccatp.config.files import write_file

    if file.exists() and not force:
        raise ConfigError(f"{file}: exists; choose another name, or replace it with --force")
    write_file(file, template(), 0o644, is_replacing=force)
    click.echo(f"{file}: uncomment what differs at your telescope, then ccatp config check {file}")


@config.command("show", epilog=common.example("ccatp config show", "ccatp config show telescope.toml --json"))
@click.argument("file", type=common.CONFIG_FILE, required=False)
@common.SETTINGS_OPTION
@common.json_option("As one JSON object.")
def config_show(file: Path | None, settings: Mapping[str, object], json_output: bool) -> None:
    """Print the whole configuration that FILE and the defaults give, mirror and world included, as TOML."""
    from ccatp.config.load import dump_config, load_mission

    cfg = load_mission(file, settings)
    click.echo(json.dumps(cfg.model_dump(mode="json")) if json_output else dump_config(cfg).rstrip())


@config.command(
    "diff", epilog=common.example("ccatp config diff telescope.toml", "ccatp config diff runs/a/config.toml new.toml")
)
@click.argument("file", type=common.CONFIG_FILE)
@click.argument("other", type=common.CONFIG_FILE, required=False)
@common.json_option("As one JSON object: key, [before, after].")
def config_diff(file: Path, other: Path | None, json_output: bool) -> None:
    """Show what FILE changes of the defaults for its mirror and world, or the changes from FILE to OTHER."""
    from ccatp.config.describe import differences
    from ccatp.config.load import load_mission
    from ccatp.config.messages import format_value

    cfg = load_mission(file)
    found = differences(cfg) if other is None else differences(load_mission(other), cfg)
    lines = [f"{k}: {format_value(before)} -> {format_value(after)}" for k, before, after in found]
    changes = {key: [before, after] for key, before, after in found}
    common.print_result(changes, lines or ["no difference"], json_output)


DEFAULT_DIR = "keys"
DEFAULT_NAME = "ccatp"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}")


def _name(_ctx: click.Context, _param: click.Parameter, name: str | None) -> str | None:
    """A name that is valid in file names and as a TOML key without quotes."""
    if name is not None and not _NAME.fullmatch(name):
        raise click.BadParameter(f"{name!r}: letters, digits, - and _ only, at most 63")
    return name


DIR_OPTION = click.option(
    "--dir", "folder", type=common.PATH, default=DEFAULT_DIR, show_default=True,
    help="Folder of the keys, for its owner alone.",
)  # fmt: skip


@click.group(cls=common.CommandGroup, epilog=common.example("ccatp keys generate --dir /etc/ccatp/keys"))
def keys() -> None:
    """Make keys and show the public ones."""


@keys.command(
    epilog=common.example(
        "ccatp keys generate --dir /etc/ccatp/keys",
        "ccatp keys generate --client --name observatory --dir ~/ccatp-keys",
    )
)
@DIR_OPTION
@click.option("--name", callback=_name, default=DEFAULT_NAME, show_default=True, help="First part of the file names.")
@click.option(
    "--client", "is_client", is_flag=True, help="For one who talks to a daemon: a CURVE pair and nothing else."
)
@click.option("--force", is_flag=True, help="Replace keys that are there already; peers then need the new ones.")
def generate(folder: Path, name: str, is_client: bool, force: bool) -> None:
    """Make a CURVE pair for the observatory channel and a key for the robot link."""
    from ccatp.config.files import FOR_OTHERS
    from ccatp.links import auth as files
    from ccatp.links.runtime_dir import make_own_dir

    folder = folder.resolve()
    for suffix in (files.PUBLIC_SUFFIX, files.SECRET_SUFFIX, *(() if is_client else (files.LINK_SUFFIX,))):
        if not force and (there := folder / f"{name}{suffix}").exists():
            raise ConfigError(f"--dir: {there} exists; choose another --name, or replace it with --force")
    make_own_dir(folder, "--dir", FOR_OTHERS)
    public, secret = files.write_pair(folder, name, is_replacing=force)
    common.print_lines([f"{public}  (public, for the peers)", f"{secret}  (secret, stays here)"])
    if is_client:
        key = files.read_public(public, "--dir").decode()
        click.echo(f'\nAdd to the list of clients at the daemon (or role = "clear"):\n\n[clients.{name}]')
        click.echo(f'public_key = "{key}"\nrole = "raise"')
        click.echo(f"\nThen: ccatp emergency KIND --endpoint tcp://HOST:PORT --server-key ccatp.key --key {secret}")
        return
    link = files.write_link_key(folder, name, is_replacing=force)
    clients = files.write_clients(folder, name)
    common.print_lines(
        [f"{link}  (secret, the same file at the robot)", f"{clients}  (clients that get in, none so far)"]
    )
    click.echo("\nAdd to the configuration, and clients to the list (ccatp keys generate --client, at theirs):\n")
    click.echo(f'[robot]\nkey_file = "{link}"\n\n[observatory]\nendpoint = "tcp://ADDRESS:7020"')
    click.echo(f'key_file = "{secret}"\nclients_file = "{clients}"')


@keys.command("show-public", epilog=common.example("ccatp keys show-public --dir /etc/ccatp/keys"))
@DIR_OPTION
@click.option("--name", callback=_name, default=None, help="One of them; all if not given.")
@common.json_option("As JSON: names and keys.")
def show_public(folder: Path, name: str | None, json_output: bool) -> None:
    """Show the public keys in a folder."""
    from ccatp.links import auth as files

    pattern = f"{name or '*'}{files.PUBLIC_SUFFIX}"
    found = {path.name.removesuffix(files.PUBLIC_SUFFIX): path for path in sorted(folder.glob(pattern))}
    if not found:
        raise ConfigError(f"--dir: no {pattern} in {folder}; make one with ccatp keys generate")
    shown: dict[str, Any] = {key: files.read_public(path, "--dir").decode() for key, path in found.items()}
    common.print_result(shown, common.columns([*shown.items()]), json_output)


SHELLS = ("bash", "zsh", "fish")
VARIABLE = "_CCATP_COMPLETE"


@common.command(
    'eval "$(ccatp completion bash)"',
    "ccatp completion zsh > ~/.zfunc/_ccatp",
    "ccatp completion fish > ~/.config/fish/completions/ccatp.fish",
)
@click.argument("shell", type=click.Choice(SHELLS), metavar="SHELL")
@click.pass_context
def completion(context: click.Context, shell: str) -> int:
    """Print the completion for SHELL: bash, zsh or fish.

    For bash put the line of the example into ~/.bashrc; for zsh a folder of $fpath takes the file.
    """
    from click.shell_completion import get_completion_class

    kind: Any = get_completion_class(shell)
    script = kind(context.find_root().command, {}, "ccatp", VARIABLE)
    if shell == "bash" and shutil.which("bash") is None:
        # click asks bash for its version first, which fails if bash is not installed.
        text = script.source_template % script.source_vars()
    else:
        text = script.source()
    sys.stdout.write(f"{text}\n")
    return 0
