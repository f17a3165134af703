"""Pictures of runs, plans, maps and radios, by matplotlib or as our own SVG."""
