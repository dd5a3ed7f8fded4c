"""Albedo maps and refined terrain models from orbital images of airless bodies.

Two products come out of images, cameras (or Sun and spacecraft positions) and a coarse DEM:
an albedo map with the exposure of every image, and a terrain model refined by shape from
shading (photoclinometry).
"""

import os

# Waiting threads must sleep: OpenMP's default of spinning makes short parallel loops twenty times
# slower as soon as another process wants the core. Read once, when the OpenMP library is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")


__version__ = "0.1.0"

__all__ = ["__version__", "albedo", "shape_from_shading"]


def __getattr__(name):
    """Load the Python interface when it is asked for, so that the commands start at once."""
    if name in ("albedo", "shape_from_shading"):
        from lommel import api

        return getattr(api, name)
    raise AttributeError(f"module 'lommel' has no attribute {name!r}")
