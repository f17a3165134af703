"""The rows of the table of conditions, by whether the danger loop finds them."""

from ccatp.conditions import Owner, all_conditions

DANGER = tuple(row for row in all_conditions() if row.owner is Owner.DANGER)
OTHERS = tuple(row for row in all_conditions() if row.owner is not Owner.DANGER)
