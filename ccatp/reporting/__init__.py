"""Pure. A report of a run: what its record says, in figures, tables and one page; and two runs beside each other.

``record`` is what ``ccatp.run_files`` reads from a run directory; the other modules think about it. A section of
the report appears where the run holds what it needs (``sections``).
"""
