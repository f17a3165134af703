"""Glue. The commands ``ccatp radio``: systems of radio beacons."""

import click

from ccatp.commands.frame import SuggestingGroup, example
from ccatp.commands.radio_calibrate import calibrate
from ccatp.commands.radio_compare import compare
from ccatp.commands.radio_fix import fix
from ccatp.commands.radio_fuzzy import fuzzy
from ccatp.commands.radio_map import radio_map
from ccatp.commands.radio_slam import slam


@click.group(cls=SuggestingGroup, epilog=example("ccatp radio slam recordings/Plaza2_.mat"))
def radio() -> None:
    """Robots among radio beacons: mapping them, finding the way by them."""


radio.add_command(slam)
radio.add_command(calibrate)
radio.add_command(fix)
radio.add_command(fuzzy)
radio.add_command(radio_map)
radio.add_command(compare)
