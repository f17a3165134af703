"""Edge. Recorded radio data: Plaza, MRCLAM, Labyrinth and a CSV of our own, each read, checked and told about."""
