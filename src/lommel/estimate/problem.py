r"""One level of shape from shading: images on cells, light at nodes, cost and its derivatives.

A `Problem` holds what a Gauss-Newton step needs on one grid of the coarse-to-fine hierarchy. Its
data term sees the surface through the two slopes of each cell; its prior term acts on the
difference to the expected surface. Most callers want `lommel.estimate.shape_from_shading`.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from lommel.core.multigrid import add_long_waves, coarse_masses, dot, threads_for
from lommel.core.normal_operator import (
    apply_operator,
    coarse_shape,
    prolong_add,
    restrict,
    slope_adjoint,
)
from lommel.core.reflectance import reflectance_model
from lommel.estimate.sampling_kernels import cast_shadow, sample_cells, slide_along
from lommel.estimate.shading_kernels import (
    SUM_COST,
    SUM_F,
    SUM_FF,
    SUM_FM,
    SUM_M,
    SUM_W,
    assemble,
    cosines,
    predict,
)
from lommel.scene.geometry import unit
from lommel.scene.masks import widened

SLOPE_STEP = 0.01  # for the change of brightness with slope: R bends little over half a degree
HAZE_ERROR = 0.1  # of the mean brightness: scattered light and film base are not more
LOWEST_SUN = 0.01  # sine of the elevation below which shadows are not followed any longer
LOWEST_VIEW = 0.1  # sine of the elevation below which a view is taken for no lower
DARK = 0.5  # of the median brightness: the image itself denies a shadow that is brighter
NOT_COUPLED = np.empty((4, 0, 0), np.float32)
# Slope that the images of a coarse cell show and its averaged posts do not have, as a share of the
# roughness: at true surfaces of simulated scenes 0.04 to 0.08 on every second post, 0.09 to 0.18 on
# every 4th to 16th (design/sfs_coarse_misfit.py)
HIDDEN_SLOPE = 0.11
HUBER_SCALE = 3.0  # noise standard errors from which a residual counts as an outlier


@dataclass(frozen=True)
class Quadratic:
    """Half the cost around a surface, to second order.

    Its arrays are memory of the `Problem`, overwritten by the next expansion.

    Attributes
    ----------
    cost : float
        Data and priors.
    tensors : float32 array (3, rows - 1, cols - 1)
    gradient : float32 array (rows, cols)
        Of data and priors with respect to the posts.
    sums : float64 array (images, 8)
    albedo : float32 array (rows - 1, cols - 1)
        Best albedo for this surface.
    """

    cost: float
    tensors: np.ndarray
    gradient: np.ndarray
    sums: np.ndarray
    albedo: np.ndarray


@dataclass(frozen=True)
class Surroundings:
    """The surface that a part of a scene is cut out of, on every so manieth post.

    Attributes
    ----------
    u : float32 array (rows, cols), m
    place : int64 array (3,)
        Row and column of the part's first post in the scene; posts per post of ``u``.
    """

    u: np.ndarray
    place: np.ndarray


NOTHING_AROUND = Surroundings(np.empty((0, 0), np.float32), np.array([0, 0, 1]))


@dataclass
class Problem:
    """One level of the coarse-to-fine hierarchy."""

    surface: object
    model: object
    views: list
    exposures: np.ndarray
    hazes: np.ndarray
    weights: np.ndarray
    stride: int
    initial: np.ndarray
    cells: np.ndarray
    albedo: np.ndarray
    curvature: np.ndarray
    masses: np.ndarray
    slope: np.ndarray
    expected: np.ndarray
    hidden_slope: float = 0.0
    albedo_error: float = 0.0
    couples_albedo: bool = False
    pins: np.ndarray | None = None
    pinned: np.ndarray | None = None
    shadows: list = field(default_factory=list)
    around: Surroundings | None = None
    brightness: np.ndarray | None = None
    mismatch: np.ndarray | float = 0.0
    geometry: list = field(default_factory=list)
    memory: dict = field(default_factory=dict)

    def see(self, u):
        """Everything that follows from where the surface ``u`` is: geometry, images, shadows."""
        self.prepare_geometry(u)
        self.shadows = []  # of another surface
        self.sample_images(u)
        self.find_shadows(u)

    def prepare_geometry(self, u):
        """Compute the lattice planes for the surface ``u``."""
        distance = min(
            np.linalg.norm(view.position) - self.surface.grid.body.radius for view in self.views
        )
        lattice = self.surface.lattice(u.shape, self.stride, distance)
        at_nodes = lattice_heights(u, lattice)
        frame = self.surface.frame(lattice, at_nodes)
        gram = frame.gram.astype(np.float32)
        lights = np.stack([light_planes(frame, view, self.model) for view in self.views])
        self.geometry = [lattice, at_nodes, frame, gram, lights]

    def expand(self, u):
        """The `Quadratic` of half the cost around ``u``."""
        tensors, gradient, sums, best, albedo_cost = self.assemble(u)
        at_posts = self._array("gradient at posts", u.shape)
        with threads_for(u.shape):
            slope_adjoint(gradient[0], gradient[1], at_posts)
        prior, prior_cost = self.prior_gradient(u)
        at_posts += prior
        cost = (sums[:, SUM_COST].sum() + albedo_cost) / 2 + prior_cost
        return Quadratic(float(cost), tensors, at_posts, sums, best)

    def _array(self, name, shape):
        """Memory that serves every step: fresh pages cost as much as filling them."""
        if name not in self.memory:
            self.memory[name] = np.empty(shape, np.float32)
        return self.memory[name]

    def assemble(self, u):
        """Tensors, slope gradient, sums, best albedo and its cost at ``u``; data only.

        The arrays are overwritten by the next call, but for the albedo that has been taken over.
        """
        lattice, _, _, gram, lights = self.geometry
        shape = self.albedo.shape
        tensors, gradient = self._array("tensors", (3, *shape)), self._array("slopes", (2, *shape))
        is_free = self.frees_albedo
        best = self.albedo
        if is_free:
            spare = self._array("albedo", shape)
            best = spare if spare is not self.albedo else self._array("other albedo", shape)
        images = [self.exposures, self.hazes, self.weights, self.weights / HUBER_SCALE**2]
        with threads_for(u.shape):
            sums, albedo_cost = assemble(
                u,
                gram,
                lights,
                lattice.step,
                self._spacing(),
                self.model.kind,
                self.model.parameter_array(),
                np.stack([self._law(u, k) for k in range(len(self.views))]),
                self.albedo,
                self.cells,
                np.stack(images, axis=1).astype(np.float32),
                np.float32(self.stride**2 / self.albedo_error**2 if is_free else -1.0),
                self.slope,
                tensors,
                gradient,
                best,
                self.coupling if self.couples_albedo else NOT_COUPLED,
            )
        return tensors, gradient, sums, best, albedo_cost

    @property
    def frees_albedo(self):
        """True where each cell's albedo is eliminated from the equations."""
        return self.albedo_error > 0

    def share_scale(self):
        """Give exposures the scale that an albedo expected to be 1 has taken up."""
        if self.frees_albedo:
            scale = self._albedo_scale()
            self.albedo /= np.float32(scale)
            self.exposures *= scale

    def scale_gain(self):
        """By how much twice the cost falls with `share_scale`."""
        if not self.frees_albedo:
            return 0.0
        total, scale = self.albedo.sum(dtype=float), self._albedo_scale()
        # of the sum of (A - 1)^2, and of (A / scale - 1)^2
        gain = total * (scale - 1) - total * (1 - 1 / scale)
        return gain * self.stride**2 / self.albedo_error**2

    def _albedo_scale(self):
        """Factor by which an albedo is too large to be nearest to 1."""
        return dot(self.albedo, self.albedo) / self.albedo.sum(dtype=float)

    @property
    def coupling(self):
        """What tied albedo and slopes at the last assembly: `assemble`'s array (4, ...)."""
        return self._array("coupling", (4, *self.albedo.shape))

    def _spacing(self):
        return np.array(self.surface.grid.spacing, np.float32) * np.float32(self.stride)

    def _law(self, u, k):
        """Reflectance and derivatives of a model without compiled twin; else a placeholder."""
        if self.model.kind >= 0:
            return np.zeros((3, 1, 1), np.float32)
        lattice, _, _, gram, lights = self.geometry
        planes = np.empty((4, *self.albedo.shape), np.float32)
        cosines(u, gram, lights[k], lattice.step, self._spacing(), planes)
        return np.stack(self.model.with_derivatives(*planes[:3])).astype(np.float32)

    def predict(self, u, k):
        """Modelled image ``k`` on the cells."""
        lattice, _, _, gram, lights = self.geometry
        out = np.empty_like(self.albedo)
        image = np.array([self.exposures[k], self.hazes[k]], np.float32)
        with threads_for(u.shape):
            predict(
                u,
                gram,
                lights[k],
                lattice.step,
                self._spacing(),
                self.model.kind,
                self.model.parameter_array(),
                self._law(u, k),
                self.albedo,
                image,
                out,
            )
        return out

    def mean_gain(self, u, k):
        """Mean change of image ``k`` with the slopes along columns and rows, image units."""
        flat = np.zeros_like(u)
        tilt = np.float32(SLOPE_STEP)
        centre = self.predict(flat, k)
        gains = []
        for axis, spacing in zip((1, 0), self._spacing()[::-1], strict=True):
            shape = [1, 1]
            shape[axis] = u.shape[axis]
            ramp = tilt * spacing * np.arange(u.shape[axis], dtype=np.float32)
            change = self.predict(np.ascontiguousarray(flat + ramp.reshape(shape)), k) - centre
            gains.append(float(change.mean() / tilt))
        return gains

    def expect(self, priors):
        """Take over priors: weights of every term, and the surface expected before the images."""
        s_row, s_col = self.surface.grid.spacing
        mean = (s_row * s_col) ** 0.5
        self.weights = np.asarray(priors.noise, float) ** -2.0
        self.hidden_slope = HIDDEN_SLOPE * priors.roughness
        curvature = np.array([1 / s_col**2, 2 / mean**2, 1 / s_row**2]) / priors.roughness**2
        signal = np.median(self.typical_brightness() / priors.noise)
        blur = (priors.albedo_contrast * signal) ** 2
        self.curvature = curvature.astype(np.float32)
        self.slope = (blur * curvature[[0, 2]]).astype(np.float32)
        self.masses = np.asarray(priors.dem_errors, float) ** -2.0
        self.expected = smoothed(self.initial, priors.smoothing)
        self.albedo_error = priors.albedo_error

    def pin(self, measured, error):
        """Hold single posts of the initial surface, and expect nothing of the others.

        Between them the surface is only as rough as terrain is; albedo is no noise here, because
        it is estimated along.

        Parameters
        ----------
        measured : bool array (rows, cols)
        error : float, m
            Standard error of a measured post.
        """
        self.pins = measured.astype(np.float32) / np.float32(error**2)
        self.pinned = self.initial
        self.expected = np.full_like(self.initial, self.initial.mean(dtype=float))
        self.masses = np.zeros(1)
        self.slope = np.zeros(2, np.float32)
        self.albedo_error = 0.0

    def hold(self, posts, weight):
        """Hold posts at given values, besides those that are pinned already.

        Parameters
        ----------
        posts : float32 array (rows, cols), m
        weight : float32 array (rows, cols), 1/m^2
        """
        if self.pins is None:
            self.pins, self.pinned = weight, posts
            return
        total = self.pins + weight
        values = self.pins * self.pinned + weight * posts
        self.pins, self.pinned = total, values / np.where(total > 0, total, np.float32(1))

    def prior_gradient(self, u):
        """Gradient of the prior terms at ``u``, and their cost."""
        cols = u.shape[1]
        change = np.subtract(u, self.expected, out=self._array("change", u.shape))
        along, across = (np.full((1, cols - 1), weight) for weight in self.slope)
        none = np.zeros_like(along)
        massless = np.zeros((1, cols), np.float32)
        out = self._array("prior", u.shape)
        with threads_for(u.shape):
            apply_operator(
                change, along, none, across, self.curvature, np.float32(0), massless, out
            )
        cost = dot(change, out) / 2
        cost += add_long_waves(change, self.masses, out) / 2
        if self.pins is not None:
            np.subtract(u, self.pinned, out=change)
            pull = self.pins * change
            out += pull
            cost += dot(change, pull) / 2
        return out, cost

    def slide_along_views(self, step, u):
        """Make a step of points along the mean view ray one of the surface, in place.

        The equations hold what a point shows in each image; above a post, a surface that rises
        meets another pixel. Where views differ, none of their ways is right, and the mean is best.

        Parameters
        ----------
        step : float32 array (rows, cols), m
        u : float32 array (rows, cols), m
        """
        lattice, at_nodes, frame, _, _ = self.geometry
        lateral = np.zeros_like(frame.xyz)
        for view in self.views:
            to_camera = unit(view.position - frame.xyz)
            rise = np.einsum("...i,...i", to_camera, frame.up)[..., None]
            lateral += to_camera / np.maximum(rise, LOWEST_VIEW) - frame.up
        crossed = self.surface.posts_crossed(lattice, at_nodes, lateral / len(self.views))
        with threads_for(u.shape):
            slide_along(step, u, (crossed - frame.drift).astype(np.float32), lattice.step)

    def sample_images(self, u):
        """Bring every image onto the cells of the surface ``u``."""
        lattice, at_nodes, frame, _, _ = self.geometry
        for view, cells in zip(self.views, self.cells, strict=True):
            planes = view.coordinates(self.surface, lattice, frame, at_nodes)
            reference = self.initial if view.is_projected else np.zeros((1, 1), np.float32)
            with threads_for(u.shape):
                sample_cells(view.image, planes, lattice.step, u, reference, cells)
        for cells, shadow in zip(self.cells, self.shadows, strict=False):
            cells[shadow] = np.nan

    def typical_brightness(self):
        """Median of each image, image units: of the whole scene where that is known."""
        if self.brightness is None:
            self.brightness = np.array([np.nanmedian(cells[::4, ::4]) for cells in self.cells])
        return self.brightness

    def find_shadows(self, u):
        """Blank the cells that terrain shadows, where the images are dark there as well."""
        lattice, at_nodes, frame, _, _ = self.geometry
        around = self.around or NOTHING_AROUND
        highest = max(u.max(), around.u.max(initial=-np.inf))
        for k, (view, cells) in enumerate(zip(self.views, self.cells, strict=True)):
            to_sun = unit(view.sun_position - frame.xyz)
            sine = np.einsum("...i,...i", to_sun, frame.up)
            lateral = to_sun / np.maximum(sine, LOWEST_SUN)[..., None] - frame.up
            rays = self.surface.posts_crossed(lattice, at_nodes, lateral).astype(np.float32)
            shadow = np.empty(cells.shape, np.bool_)
            darkest = np.float32(DARK * self.typical_brightness()[k])
            with threads_for(u.shape):
                cast_shadow(
                    u,
                    rays,
                    lattice.step,
                    around.u,
                    around.place,
                    highest,
                    cells,
                    darkest,
                    shadow,
                )
            self.shadows.append(widened(shadow))
            cells[self.shadows[-1]] = np.nan

    def single_image(self, k):
        """The same level as image ``k`` alone sees it, with memory of its own."""
        *geometry, lights = self.geometry
        return replace(
            self,
            views=self.views[k : k + 1],
            exposures=self.exposures[k : k + 1],
            hazes=self.hazes[k : k + 1],
            weights=self.weights[k : k + 1],
            cells=self.cells[k : k + 1],
            brightness=None if self.brightness is None else self.brightness[k : k + 1],
            geometry=[*geometry, lights[k : k + 1]],
            memory={},
        )

    def coarser(self):
        """The same problem on every second post."""
        coarse = replace(
            self,
            exposures=self.exposures.copy(),
            stride=2 * self.stride,
            shadows=[],
            around=None,
            memory={},
            initial=coarse_posts(self.initial),
            expected=coarse_posts(self.expected),
            cells=np.stack([coarse_cells(cells) for cells in self.cells]),
            albedo=np.nan_to_num(coarse_cells(self.albedo), nan=1.0),
            curvature=self.curvature / 4,
            masses=coarse_masses(self.masses, 1),
        )
        if self.pins is not None:
            coarse.pins, coarse.pinned = coarse_pins(self.pins, self.pinned)
        coarse.prepare_geometry(coarse.initial)
        if self.stride == 1:
            images = range(len(self.views))
            gains = [np.hypot(*coarse.mean_gain(coarse.initial, k)) for k in images]
            coarse.mismatch = (self.hidden_slope * np.array(gains)) ** 2
        coarse.weights = 1 / ((1 / self.weights - self.mismatch) / 4 + coarse.mismatch)
        return coarse


def fresh_problem(surface, initial, views, model, albedo):
    """The finest level before images are sampled and priors known; see `solve_surface`."""
    rows, cols = initial.shape
    count = len(views)
    if albedo is None:
        albedo = np.ones((rows - 1, cols - 1), np.float32)
    return Problem(
        surface,
        model,
        views,
        np.ones(count),
        np.zeros(count),
        np.ones(count),
        1,
        np.ascontiguousarray(initial, np.float32),
        np.empty((count, rows - 1, cols - 1), np.float32),
        albedo,
        curvature=np.zeros(3, np.float32),
        masses=np.zeros(1),
        slope=np.zeros(2, np.float32),
        expected=initial,
    )


def light_planes(frame, view, model):
    """Light and view along the normal's vectors, phase share and factor, at the nodes.

    Parameters
    ----------
    frame : Frame
    view : OrthoView or CameraView
    model : ReflectanceModel

    Returns
    -------
    planes : float32 array (8, node_rows, node_cols)
    """
    to_sun = unit(view.sun_position - frame.xyz)
    to_camera = unit(view.position - frame.xyz)
    phase = np.arccos(np.clip(np.einsum("...i,...i", to_sun, to_camera), -1, 1))
    share, factor = model.phase_terms(phase)
    planes = [np.einsum("...i,...i", frame.c[k], to_sun) for k in range(3)]
    planes += [np.einsum("...i,...i", frame.c[k], to_camera) for k in range(3)]
    return np.stack([*planes, share, factor]).astype(np.float32)


def lambert_image(surface, u, view):
    """Cosine of incidence on the cells of a surface, under the Sun of a view; 0 where turned away.

    Parameters
    ----------
    surface : Surface
    u : float32 array (rows, cols), m
    view : OrthoView or CameraView

    Returns
    -------
    cosine : float32 array (rows - 1, cols - 1), dimensionless
    """
    level = fresh_problem(surface, u, [view], reflectance_model("lambert"), None)
    level.prepare_geometry(u)
    return level.predict(u, 0)


def lattice_heights(u, lattice):
    """Values of a post array at the nodes of a lattice, averaged over a cell of the lattice."""
    half = max(lattice.step // 2, 0)
    row = np.minimum((lattice.row[:, 0] / lattice.stride).astype(int), u.shape[0] - 1)
    col = np.minimum((lattice.col[0] / lattice.stride).astype(int), u.shape[1] - 1)
    total = np.zeros((row.size, col.size))
    offsets = sorted({-half, 0, half})
    for dr in offsets:
        for dc in offsets:
            rows = np.clip(row + dr, 0, u.shape[0] - 1)
            cols = np.clip(col + dc, 0, u.shape[1] - 1)
            total += u[rows[:, None], cols[None, :]]
    return total / len(offsets) ** 2


def coarse_cells(cells):
    """Mean of 2x2 cells; NaN where one is missing or beyond the border."""
    rows, cols = cells.shape
    out = np.full(((rows + 1) // 2, (cols + 1) // 2), np.nan, np.float32)
    even = cells[: rows // 2 * 2, : cols // 2 * 2]
    out[: rows // 2, : cols // 2] = 0.25 * (
        even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]
    )
    return out


def coarse_posts(posts):
    """Weighted mean around every second post."""
    total = np.zeros(coarse_shape(posts.shape), np.float32)
    weight = np.zeros_like(total)
    restrict(np.ascontiguousarray(posts), total)
    restrict(np.ones_like(posts), weight)
    return total / weight


def coarse_pins(pins, pinned):
    """Weights of single posts and the values they hold, gathered on every second post."""
    weight = np.empty(coarse_shape(pins.shape), np.float32)
    total = np.empty_like(weight)
    restrict(pins, weight)
    restrict(pins * pinned, total)
    return weight, total / np.where(weight > 0, weight, 1)


def smoothed(posts, sigma):
    """Posts averaged over about ``sigma`` of them (standard deviation).

    Averages on a grid halved so often are spread again as a cubic spline, by repeated
    interpolation and averaging: a Gaussian in effect, at a cost that does not grow with its width.
    """
    if sigma < 1:
        return posts
    levels = [posts]
    while 2 ** len(levels) <= sigma:
        levels.append(coarse_posts(levels[-1]))
    spread = _binomial(levels.pop())
    for finer in reversed(levels):
        fine = np.zeros_like(finer)
        prolong_add(spread, fine)
        spread = _binomial(fine)
    return spread


def _binomial(posts):
    """Averages with weights 1/4, 1/2, 1/4 along rows and columns."""
    for axis in (0, 1):
        posts, ahead = posts.copy(), np.moveaxis(posts, axis, 0)
        inside = np.moveaxis(posts, axis, 0)[1:-1]
        inside *= np.float32(0.5)
        inside += np.float32(0.25) * ahead[:-2]
        inside += np.float32(0.25) * ahead[2:]
    return posts


def best_photometry(sums, exposures, hazes, estimate_haze, keeps_scale=False):
    """Exposures, and hazes if asked for, that fit the images best.

    Parameters
    ----------
    sums : float64 array (images, 8)
        Of `Problem.assemble`.
    exposures, hazes : array (images,)
        As they are; kept where an image has no data.
    estimate_haze : bool
        With an expectation of 0 and a standard error of `HAZE_ERROR` of the mean brightness.
    keeps_scale : bool
        Only ratios of exposures change: their common scale is what an albedo that is free takes up.

    Returns
    -------
    exposures, hazes : array (images,)
    """
    w, f, ff, fm, m = (sums[:, column] for column in (SUM_W, SUM_F, SUM_FF, SUM_FM, SUM_M))
    has_data = (ff > 0) & (m > 0)
    if estimate_haze:
        pull = (w / np.where(has_data, HAZE_ERROR * m, 1)) ** 2
        determinant = np.where(has_data, ff * (w + pull) - f**2, 1)
        haze = (ff * m - f * fm) / determinant
        hazes = np.where(has_data, haze, hazes)
        exposure = (fm * (w + pull) - f * m) / determinant
    else:
        exposure = (fm - hazes * f) / np.where(has_data, ff, 1)
    exposure = np.where(has_data, exposure, exposures)
    if keeps_scale:
        exposure = exposures * (1 + _ratios(exposure / exposures - 1, exposures**2 * ff))
    return exposure, hazes


def exposure_gain(sums, exposures, hazes, keeps_scale=False):
    """By how much twice the cost falls when each exposure takes its best value.

    Parameters
    ----------
    sums : float64 array (images, 8)
    exposures, hazes : array (images,)
    keeps_scale : bool
        As of `best_photometry`.

    Returns
    -------
    gain : float
    """
    weights = exposures**2 * sums[:, SUM_FF]
    best, _ = best_photometry(sums, exposures, hazes, False, keeps_scale)
    return float((weights * (best / exposures - 1) ** 2).sum())


def _ratios(change, weights):
    """Relative changes without the one that all images have in common."""
    return change - (weights @ change) / max(weights.sum(), np.finfo(float).tiny)
