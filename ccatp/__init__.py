"""Robot-controller daemon that surveys telescope mirrors with a laser-tracked puck."""

__version__ = "0.1.0"
