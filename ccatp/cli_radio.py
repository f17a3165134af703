"""Glue. The commands ``ccatp radio``: systems of radio beacons."""

import click

from ccatp.cli_frame import SuggestingGroup, example
from ccatp.cli_radio_slam import slam


@click.group(cls=SuggestingGroup, epilog=example("ccatp radio slam recordings/Plaza2_.mat"))
def radio() -> None:
    """Robots among radio beacons: mapping them, finding the way by them."""


radio.add_command(slam)
