"""Edge. The collector of garbage, kept from what will never be garbage."""

import gc


def settle() -> None:
    """Collect what is garbage now, and look no more at what is not: modules and tables stay to the end.

    A mission makes tuples by the million and hardly a cycle; going through everything imported again and again for
    them costs it 3 % of its time.
    """
    gc.collect()
    gc.freeze()
