"""The rows of the table of conditions, by whether the danger loop finds them."""

from ccatp.conditions import TABLE, Owner

DANGER = tuple(row for row in TABLE.values() if row.owner is Owner.DANGER)
OTHERS = tuple(row for row in TABLE.values() if row.owner is not Owner.DANGER)
