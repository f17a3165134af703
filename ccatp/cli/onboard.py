"""The command ``ccatp onboard``: the program on the robot's own computer."""

import socket
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import click

from ccatp.cli import common
from ccatp.errors import CcatpError, ConfigError, ExitStatus

if TYPE_CHECKING:
    from ccatp.onboard.kinds import OnboardCommonConfig, RobotKind
    from ccatp.onboard.tuning import Tuning

CHECK_S = 2.0
_BACKLOG = 32


class DeviceUnreachable(CcatpError):
    """A device of the robot does not work as required."""

    exit_status = ExitStatus.UNREACHABLE


@click.group(
    "onboard", cls=common.CommandGroup, invoke_without_command=True,
    epilog=common.example("ccatp onboard --config robot.toml --check", "ccatp onboard --config robot.toml"),
)  # fmt: skip
@common.CONFIG_OPTION
@common.address_options("link")
@common.SETTINGS_OPTION
@click.option("--check", "is_check", is_flag=True, help="Look at each device, without driving, and end.")
@common.JSON_OPTION
@click.pass_context
def onboard(
    ctx: click.Context, config_file: Path | None, settings: Mapping[str, object], is_check: bool, json_output: bool
) -> int:
    """Run the program on the robot's own computer: link server, low-level control, devices.

    Without --config the configuration is that of configs/onboard.toml. The key kind selects another kind of robot. The
    program ends on SIGTERM or Ctrl-C: the wheels brake, the fans stay.
    """
    ctx.obj = config_file
    if ctx.invoked_subcommand is not None:
        return 0
    from ccatp.onboard.kinds import load_robot_config

    kind, cfg = load_robot_config(config_file, settings)
    return _check(kind, cfg, json_output=json_output) if is_check else _run(kind, cfg)


def _run(kind: "RobotKind", cfg: "OnboardCommonConfig") -> int:
    import sys
    from functools import partial

    import structlog

    from ccatp.config.files import read_key
    from ccatp.onboard.hardware import HardwareError
    from ccatp.onboard.program import run

    key = read_key(cfg.link.key_file, must_be_private=True, what="link.key_file")
    if key is None and cfg.link.host not in {"127.0.0.1", "::1", "localhost"}:
        common.warn([f"without link.key_file anyone who reaches {cfg.link.host}:{cfg.link.port} can drive the robot"])
    log = structlog.wrap_logger(structlog.PrintLogger(sys.stderr))
    with _listen(cfg.link.host, cfg.link.port) as listener:
        host, port = listener.getsockname()[:2]
        click.echo(f"ccatp: robot on {host}:{port}", err=True)
        try:
            return run(partial(kind.hardware, cfg), partial(kind.robot, cfg), listener, key, log)
        except HardwareError as error:
            raise DeviceUnreachable(str(error)) from error


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except OSError as error:
        why = (error.strerror or str(error)).partition(" (while")[0]
        raise ConfigError(
            f"link.port: cannot listen on {host}:{port}: {why}; stop who uses it, or set another"
        ) from error


def _check(kind: "RobotKind", cfg: "OnboardCommonConfig", *, json_output: bool) -> int:
    boot_s = time.monotonic()
    checks = kind.hardware(cfg, lambda: time.monotonic() - boot_s).check(CHECK_S)
    lines = []
    for check in checks:
        found = f"{check.identity or 'found'}" if check.found else "not found"
        figures = f"{check.rate_hz:.0f}/s" if check.rate_hz else "-"
        verdict = "ok" if check.passed else "FAIL"
        advice = "" if check.passed else f"; {check.advice}"
        lines.append(f"{check.device:<14} {verdict:<5} {figures:>7}  {found}  {check.noise}{advice}".rstrip())
    common.print_result([check._asdict() for check in checks], lines, json_output)
    return ExitStatus.COMPLETE if all(check.passed for check in checks) else ExitStatus.UNREACHABLE


@onboard.command(epilog=common.example("ccatp onboard tune --config robot.toml --wheels-are-free --out tuning"))
@common.CONFIG_OPTION
@common.SETTINGS_OPTION
@click.option("--wheels-are-free", is_flag=True, help="The robot is lifted: its wheels turn at up to full speed.")
@click.option(
    "--out",
    "out_dir",
    type=common.OutputFolder(),
    help="Folder for the step response: CSV, and a figure with matplotlib.",
)  # fmt: skip
@common.JSON_OPTION
@click.pass_obj
def tune(
    group_config: Path | None, config_file: Path | None, settings: Mapping[str, object], wheels_are_free: bool,
    out_dir: Path | None, json_output: bool,
) -> int:  # fmt: skip
    """Find friction, slope and gains of the wheel servos with free wheels, in about half a minute."""
    from ccatp.config.load import load_onboard_config
    from ccatp.onboard.devices.linux import LinuxHardware
    from ccatp.onboard.hardware import HardwareError
    from ccatp.onboard.kinds import kind_in
    from ccatp.onboard.tuning import tune as find

    if why := kind_in(config_file or group_config, settings).no_tuning:
        raise click.UsageError(why)
    if not wheels_are_free:
        raise click.UsageError("the wheels will turn at up to full speed: lift the robot, then add --wheels-are-free")
    cfg = load_onboard_config(config_file or group_config, settings)
    boot_s = time.monotonic()

    def clock() -> float:
        return time.monotonic() - boot_s

    hardware = LinuxHardware(cfg.devices, clock)
    try:
        hardware.start()
        found = find(hardware, cfg.servo, clock, time.sleep, lambda text: click.echo(text, err=True))
    except HardwareError as error:
        raise DeviceUnreachable(str(error)) from error
    finally:
        hardware.close()
    if out_dir is not None:
        write_tuning(out_dir, found)
    wheels = {"right": found.right, "left": found.left}
    lines = [
        f"{name:<6} static {wheel.static_v:.2f} V, {wheel.volt_per_rad_s:.3f} V per rad/s, "
        f"time constant {1e3 * wheel.time_constant_s:.0f} ms, fit to {wheel.residual_v:.2f} V"
        for name, wheel in wheels.items()
    ]
    course = f"{found.deviation_rad_s:.3f} rad/s rms, overshoot {found.overshoot_share:.1%}"
    lines += [f"step: off its course by {course}", "", "[servo]"]
    lines += [f"{key} = {value}" for key, value in found.values.items()]
    result = {**found._asdict(), **{name: wheel._asdict() for name, wheel in wheels.items()}}
    common.print_result(result, lines, json_output)
    return 0


def write_tuning(folder: Path, found: "Tuning") -> None:
    """``step.csv`` and, where matplotlib is installed, ``step.png``."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{t_s:.4f},{rate:.4f},{wanted:.4f}" for t_s, rate, wanted in found.step]
    (folder / "step.csv").write_text("\n".join(["t_s,speed_rad_s,wanted_rad_s", *rows]) + "\n", encoding="utf-8")
    try:
        from matplotlib.figure import Figure
    except ModuleNotFoundError:
        return
    figure = Figure(figsize=(6.0, 3.5), layout="constrained")
    axes = figure.add_subplot()
    t_s, rate, wanted = zip(*found.step, strict=True)
    axes.plot(t_s, rate, label="right wheel")
    axes.plot(t_s, wanted, "--", label="wanted")
    axes.set(xlabel="time, s", ylabel="wheel speed, rad/s", title="Step with the new gains")
    axes.legend()
    figure.savefig(folder / "step.png", dpi=150)


def main() -> int:
    """Entry of ``ccatp-onboard``, the small package for the robot's computer."""
    return common.run_command_line(onboard)
