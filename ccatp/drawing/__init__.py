"""Pure. Pictures as lists of shapes, in pixels: drawn once, written as SVG here or as PNG and PDF by ``picture_file``.

Knows nothing of robots and mirrors. A picture does not depend on which file it will be written to, so that a report on
a screen and its figures in a paper are the same.
"""
