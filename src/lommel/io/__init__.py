"""One file format per module; every reader returns arrays and ``scene`` objects."""
