"""Pure. Motes that map themselves from the ranges between them: what can be known, a first map, the best map."""
