"""Scenes with a known answer, and what solving them costs; `make bench` runs `__main__`."""
