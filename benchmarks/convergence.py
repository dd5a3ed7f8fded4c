"""How many V-cycles the single-image case needs, and how far from the minimum the default stops.

With one image the data see slopes towards the Sun only; across it the priors hold the surface. The
table asks for the cycles at three strengths of these priors and at several sizes. Most callers
want `iterations` and `excess_cost`.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from lommel.core.multigrid import NormalEquations, conjugate_gradients
from lommel.core.reflectance import reflectance_model
from lommel.estimate.problem import fresh_problem
from lommel.estimate.shape_from_shading import SolverSettings, solve_surface
from lommel.estimate.surface import Surface
from lommel.io.raster import read_pixels
from lommel.run.inputs import SceneFiles
from lommel.run.views import read_views

STRENGTHS = {"strong": 1 / 3, "middling": 1.0, "weak": 3.0}  # times the estimated roughness
REDUCTIONS = (1e-1, 1e-2, 1e-3, 1e-4)
MAX_CYCLES = 200
# Far more than the default; tighter linear solves overshoot where the problem is not convex
LONG = SolverSettings(
    max_steps=16, step_tolerance=1e-5, gain_tolerance=1e-5, cycle_tolerance=0.05, max_cycles=60
)


class SingleImage:
    """A scene with one image, read once.

    Parameters
    ----------
    folder : path
    """

    def __init__(self, folder):
        folder = Path(folder)
        files = SceneFiles(
            images=(folder / "img1.tif",),
            dems=(folder / "init_dem.tif",),
            sun_positions=folder / "sun_positions.txt",
        )
        scene = read_views(files)
        self.views = scene.views
        self.surface = Surface(scene.grid, float(scene.heights.mean(dtype=float)))
        self.initial = self.surface.posts_from_heights(scene.heights)
        self.truth = self.surface.posts_from_heights(read_pixels(folder / "truth_dem.tif"))
        self.model = reflectance_model("lunar-lambert")

    def solve(self, priors=None, settings=None):
        """The `Solution`; its history tells the cost of each step."""
        return solve_surface(self.surface, self.initial, self.views, self.model, priors, settings)


def scaled(priors, strength):
    """Priors with errors and roughness times a factor."""
    return replace(
        priors,
        roughness=priors.roughness * strength,
        dem_errors=np.asarray(priors.dem_errors) * strength,
    )


def iterations(scene, priors):
    """Cycles to each of `REDUCTIONS` for the step from the initial to the true surface."""
    level = fresh_problem(scene.surface, scene.initial, scene.views, scene.model, None)
    level.prepare_geometry(scene.truth)
    level.sample_images(scene.truth)
    level.exposures[:] = 100.0
    level.expect(priors)
    here = level.expand(scene.truth)
    equations = NormalEquations(tuple(here.tensors), level.curvature, level.masses)
    right_hand_side = np.empty_like(scene.initial)
    equations.apply(scene.truth - scene.initial, right_hand_side)
    return [
        conjugate_gradients(equations, right_hand_side, reduction, MAX_CYCLES).iterations
        for reduction in REDUCTIONS
    ]


def excess_cost(scene, priors):
    """Cost after the default stop, relative to that after a long solve, minus 1; cycles of both."""
    histories = scene.solve(priors).history, scene.solve(priors, LONG).history
    costs = [history[-1]["cost"] for history in histories]
    cycles = [[step["cycles"] for step in one if step["stride"] == 1] for one in histories]
    return costs[0] / costs[1] - 1, *cycles
