"""Route planning: the order of the points, drivable legs between them, the way home, and time bounds.

``route`` and ``way_home`` are used by the survey, ``plan`` by ``ccatp plan``.
"""
