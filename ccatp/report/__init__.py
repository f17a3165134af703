"""Views of a run: HTML report, comparison, figures, dashboard, Foxglove and PlotJuggler streams."""
