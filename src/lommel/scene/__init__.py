"""Where things are: bodies, grids, cameras, light and view."""
