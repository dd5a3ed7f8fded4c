"""Which V-cycle serves shape from shading with a single image best.

With one image the tensor of every cell has rank one: the data hold the surface along the Sun, only
the curvature prior holds it across. Stripes along the Sun are then the slowest modes. This script
counts preconditioned iterations, and their work in applications of the finest operator, for the
degree of the Chebyshev smoother and the share of tr(G) that resists a coarse cell's twist.

Work to a reduction by 1e-3 at curvature weights of 1e-2, 3e-3, 3e-4 of the data's: degree 3
everywhere with tr(G)/12 takes 114, 124, 134; degree 2 that doubles from level to level with
tr(G)/64 takes 90, 80, 70. On a measured system (one image, priors as estimated) it was 270 against
165; a W-cycle and Galerkin coarse operators gained nothing there, cubic transfer a further tenth.

    python design/sfs_vcycle.py
"""

import numpy as np
from scipy.ndimage import gaussian_filter

from lommel.core import multigrid

POSTS = 512
AZIMUTH = np.radians(30.0)
VARIANTS = {  # degree on the finest level, largest degree, twist's share
    "degree 3 everywhere, tr(G)/12": (3, 3, 1 / 12),
    "degree 5 everywhere, tr(G)/12": (5, 5, 1 / 12),
    "degree 3 everywhere, tr(G)/64": (3, 3, 1 / 64),
    "degree 3, 6, 12, 24, tr(G)/12": (3, 24, 1 / 12),
    "degree 3, 6, 12, 24, tr(G)/64": (3, 24, 1 / 64),
    "degree 2, 4, 8, 16, tr(G)/64": (2, 16, 1 / 64),
}


def main():
    """Print the table."""
    rng = np.random.default_rng(0)
    gain = 1 + 2 * gaussian_filter(rng.standard_normal((POSTS - 1, POSTS - 1)), 3)
    along, across = np.cos(AZIMUTH) * gain, np.sin(AZIMUTH) * gain
    tensors = tuple(t.astype(np.float32) for t in (along**2, along * across, across**2))
    truth = gaussian_filter(rng.standard_normal((POSTS, POSTS)), 4) * 50
    truth += gaussian_filter(rng.standard_normal((POSTS, POSTS)), 16) * 800
    for curvature in (1e-2, 3e-3, 3e-4):
        print(f"curvature weight {curvature:g} of the data's")
        weights = np.float32(curvature) * np.array([1, 2, 1], np.float32)
        masses = np.array([0, 0, 0, curvature, 4 * curvature])
        for name, (degree, largest, twist) in VARIANTS.items():
            multigrid.DEGREE, multigrid.LARGEST_DEGREE = degree, largest
            multigrid.HOURGLASS = twist
            equations = multigrid.NormalEquations(tensors, weights, masses)
            right_hand_side = np.empty((POSTS, POSTS), np.float32)
            equations.apply(truth.astype(np.float32), right_hand_side)
            work = 1 + sum((2 * lv.degree + 1) / 4**k for k, lv in enumerate(equations.levels))
            counts = [
                multigrid.conjugate_gradients(equations, right_hand_side, goal, 300).iterations
                for goal in (1e-1, 1e-2, 1e-3)
            ]
            print(f"  {name:32}", *(f"{n:3d} /{n * work:5.0f}" for n in counts), flush=True)


if __name__ == "__main__":
    main()
