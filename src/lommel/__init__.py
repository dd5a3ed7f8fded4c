"""Albedo maps and refined terrain models from orbital images of airless bodies.

Two products come out of images, cameras (or Sun and spacecraft positions) and a coarse DEM:
an albedo map with the exposure of every image, and a terrain model refined by shape from
shading (photoclinometry).
"""

__version__ = "0.1.0"

__all__ = ["__version__"]
