r"""The small system of the albedo problem: image parameters, albedo eliminated.

One pass over the images (`visit`) leaves sums; from these come the objective, its gradient and
Gauss-Newton matrix (`normal_equations`) and standard errors. Nothing here sees a pixel.
Unknowns stand in this order: log exposure and haze (in units of the image's level) of each image,
then c1, c2, v2, v4 of all and the mean log albedo.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from lommel.estimate.albedo_arrays import (
    OWN,
    SCALE_LOW,
    SCALE_STEP,
    SHARED,
    Pairs,
    State,
    Sums,
)
from lommel.estimate.albedo_kernels import Visitor, accumulate
from lommel.estimate.albedo_rows import LOSSES
from lommel.estimate.albedo_samples import SampleBlocks
from lommel.estimate.albedo_settings import AlbedoSettings

# Prior standard errors of c1, c2, v2, v4. A strip under one Sun cannot tell phase from a trend of
# albedo, so the lunar phase function is taken as known to a tenth; falloff is left loose.
SHARED_ERROR = np.array([0.1, 0.05, 3.0, 3.0])
LEAST_HAZE = 1e-3  # spread of haze, as a share of the level, that counts as none
PIN = 1e-9  # of the diagonal, added where the gauge would make the matrix singular


@dataclass(frozen=True, eq=False)
class Problem:
    """Samples, settings and the layout of the unknowns.

    Attributes
    ----------
    blocks : SampleBlocks
    pairs : Pairs
    settings : AlbedoSettings
    is_fitted : bool array (2 K + 5,)
        Log exposure and haze of each image, then c1, c2, v2, v4 and the mean log albedo.
    shared_start : float64 array (4,)
    """

    blocks: SampleBlocks
    pairs: Pairs
    settings: AlbedoSettings
    is_fitted: np.ndarray
    shared_start: np.ndarray

    @property
    def images(self):
        """Number of images used."""
        return len(self.blocks.levels)

    @property
    def haze_errors(self):
        """Expected spread of the haze of each image, as a share of its level.

        Its square goes with the completeness: where clipping and shadow leave few whole cells, they
        have cut one end of the contrast that haze is told by, which itself looks like haze.
        """
        return self.settings.haze_error * np.sqrt(self.blocks.completeness)


@dataclass(eq=False)
class Point:
    """One pass: the parameters, and the sums that belong to them.

    Attributes
    ----------
    state : State
    mean_log_albedo : float
    scale, repetition : float
        What the pass was weighted with.
    sums : Sums
    objective : float
    """

    state: State
    mean_log_albedo: float
    scale: float
    repetition: float
    sums: Sums
    objective: float


def visitor_of(problem, state, scale, is_step=True):
    """What a pass over the images does at these parameters; see `Visitor`."""
    loss = LOSSES[problem.settings.loss]
    return Visitor(problem.blocks, problem.pairs, state, scale, loss, is_step)


def visit(problem, state, mean_log_albedo, scale, repetition):
    """One pass over the images: the sums and objective at these parameters; see `accumulate`."""
    sums = accumulate(visitor_of(problem, state, scale))
    point = Point(state, mean_log_albedo, scale, repetition, sums, 0.0)
    point.objective = float(sums.cost[0]) / repetition
    if problem.settings.solver == "projection":
        residual, _, error = priors(problem, point)
        point.objective += 0.5 * float(np.sum((residual / error) ** 2))
    return point


def noise_scale(histogram):
    """Normalised median absolute deviation, from a histogram of residual sizes.

    Parameters
    ----------
    histogram : array (SCALE_BINS,)

    Returns
    -------
    scale : float; NaN when the histogram is empty, as with one image
    """
    below = np.cumsum(histogram)
    if below[-1] == 0:
        return float("nan")
    place = np.interp(0.5 * below[-1], below, np.arange(1, len(below) + 1))
    return float(1.4826 * 2.0 ** (SCALE_LOW + SCALE_STEP * place))


def effective_repetition(sums):
    r"""Pixels per independent residual, at least 1.

    Model errors are alike over patches of an image, and over the same patch of all images (where
    phase and lens are alike). The scores :math:`\psi = \rho'` of the robust loss, summed over
    patches, show it: with independent residuals the ratio is 1.

    .. math:: \varphi = \max\left(1, \frac{\sum_{k,p} (\sum \psi)^2}{\sum \psi^2},
              \frac{\sum_p (\sum_k \sum \psi)^2}{\sum \psi^2}\right)

    Parameters
    ----------
    sums : Sums

    Returns
    -------
    repetition : float
    """
    total = max(float(sums.score_square[0]), 1e-300)
    apart = float(np.sum(sums.patches**2)) / total
    together = float(np.sum(sums.patches.sum(axis=0) ** 2)) / total
    return max(1.0, apart, together)


def priors(problem, point):
    """Prior residuals, their Jacobian (sparse, all unknowns) and their standard errors."""
    settings, state = problem.settings, point.state
    images = problem.images
    weight = point.sums.means[:, 0]
    measured = np.maximum(point.sums.means[:, 1] / weight - state.haze, 0.01 * state.level)
    modelled = point.sums.means[:, 2] / weight
    contrast = np.log(modelled) - np.log(measured) + point.mean_log_albedo
    haze = state.haze / state.level
    residual = np.concatenate([contrast, haze, state.shared - problem.shared_start])
    error = np.concatenate(
        [
            np.full(images, settings.albedo_contrast),
            problem.haze_errors,
            SHARED_ERROR,
        ]
    )
    jacobian = np.zeros((images, SHARED + 1))
    jacobian[:, :SHARED] = point.sums.means[:, 3:] / point.sums.means[:, 2:3]
    jacobian[:, SHARED] = 1.0
    k = np.arange(images)
    last = OWN * images
    rows = [k, k, np.repeat(k, SHARED + 1), images + k, 2 * images + np.arange(SHARED)]
    cols = [OWN * k, OWN * k + 1, np.tile(last + np.arange(SHARED + 1), images), OWN * k + 1]
    cols.append(last + np.arange(SHARED))
    values = [np.ones(images), state.level / measured, jacobian.ravel(), np.ones(images + SHARED)]
    triplets = np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))
    return residual, csr_matrix(triplets, shape=(residual.size, last + SHARED + 1)), error


def normal_equations(problem, point):
    """Matrix and gradient of the objective over all unknowns, albedo eliminated.

    Parameters
    ----------
    problem : Problem
    point : Point

    Returns
    -------
    matrix : scipy.sparse.csr_matrix (2 K + 5, 2 K + 5)
    gradient : float64 array (2 K + 5,)
    """
    sums, images = point.sums, problem.images
    last = OWN * images
    size = last + SHARED + 1
    entries = []

    def put(row, col, value):
        entries.append([np.broadcast_to(part, value.shape).ravel() for part in (row, col, value)])

    k, p = np.arange(images)[:, None, None], np.arange(OWN)
    own = sums.own + np.triu(sums.own, 1).transpose(0, 2, 1)
    put(OWN * k + p[:, None], OWN * k + p, own)
    i = np.repeat(np.arange(images), np.diff(problem.pairs.first))[:, None, None]
    j = problem.pairs.second[:, None, None]
    put(OWN * i + p[:, None], OWN * j + p, -sums.pairs)
    others = (i != j)[:, 0, 0]
    put(
        (OWN * j + p[:, None])[others],
        (OWN * i + p)[others],
        -sums.pairs[others].transpose(0, 2, 1),
    )
    g = last + np.arange(SHARED)
    put(OWN * k + p[:, None], g, sums.border)
    put(g, OWN * k + p[:, None], sums.border)
    put(g[:, None], g, sums.square + np.triu(sums.square, 1).T)
    rows, cols, values = (np.concatenate(part) for part in zip(*entries, strict=True))
    factor = 1.0 / (point.scale**2 * point.repetition)
    matrix = coo_matrix((factor * values, (rows, cols)), shape=(size, size)).tocsr()
    gradient = np.zeros(size)
    gradient[:last] = factor * sums.gradient.ravel()
    gradient[g] = factor * sums.shared_gradient
    if problem.settings.solver == "projection":
        residual, jacobian, error = priors(problem, point)
        scaled = jacobian.multiply(1.0 / error[:, None] ** 2).tocsr()
        matrix, gradient = matrix + jacobian.T @ scaled, gradient + scaled.T @ residual
    return matrix, gradient


class Factors:
    """Normal matrix of the fitted unknowns in factors, hazes held to a mean of 0.

    A haze that is the same share of all images cannot be told from contrast that the DEM's relief
    lacks, so the mean of the hazes, in units of the images' levels, is a gauge.

    Parameters
    ----------
    problem : Problem
    matrix : sparse matrix (2 K + 5, 2 K + 5)
        From `normal_equations`.
    damping : float
        Share of the diagonal added to it.

    Attributes
    ----------
    fitted : int array (n,)
        Indices of the fitted unknowns.
    """

    def __init__(self, problem, matrix, damping=0.0):
        self.fitted = np.flatnonzero(problem.is_fitted)
        matrix = matrix[self.fitted][:, self.fitted].tocsc()
        matrix.setdiag(matrix.diagonal() * (1.0 + damping + PIN))
        self.free = splu(matrix).solve
        is_own = self.fitted < OWN * problem.images
        self.hazes = (is_own & (self.fitted % OWN == 1)).astype(float)
        self.along = self.free(self.hazes)

    def solve(self, right):
        """Solution for one or more right sides, array (n,) or (n, m)."""
        answer = self.free(right)
        if not self.hazes.any():
            return answer
        excess = (self.hazes @ answer) / (self.hazes @ self.along)
        return answer - np.multiply.outer(self.along, excess)


def standard_errors(problem, point):
    """Standard errors of all unknowns with the mean log exposure held; 0 where not fitted."""
    factors = Factors(problem, normal_equations(problem, point)[0])
    fitted = factors.fitted
    # Projected onto mean log exposure 0: P C P^T with P = 1 - (mean over log exposures)
    is_exposure = (fitted < OWN * problem.images) & (fitted % OWN == 0)
    unit_mean = is_exposure / problem.images
    total = factors.solve(unit_mean)
    mean_variance = float(unit_mean @ total)
    variance = np.empty(fitted.size)
    for first in range(0, fitted.size, 256):
        part = np.arange(first, min(first + 256, fitted.size))
        unit_vectors = np.zeros((fitted.size, part.size))
        unit_vectors[part, part - first] = 1.0
        variance[part] = factors.solve(unit_vectors)[part, part - first]
    variance -= np.where(is_exposure, 2 * total - mean_variance, 0.0)
    errors = np.zeros(problem.is_fitted.size)
    errors[fitted] = np.sqrt(np.maximum(variance, 0.0))
    return errors


def haze_spread(problem, point, most):
    r"""Standard deviation of haze from image to image that the images themselves show.

    One step towards the largest evidence (MacKay 1992, Neural Comput. 4, 415-447): with the hazes
    :math:`h_k = b^k / \ell^k`, their standard errors :math:`e_k` and what was expected,
    :math:`\sigma_b \sqrt{c_k}` with the completeness :math:`c_k`,

    .. math:: \sigma_b^2 \leftarrow 1.4826^2 \operatorname{median}_k \frac{h_k^2}{c_k \gamma_k},
              \qquad \gamma_k = 1 - \frac{e_k^2}{c_k \sigma_b^2}

    Images count by :math:`\gamma_k`, how much of their haze they tell themselves. It is a median in
    place of MacKay's mean, so that a few images with a feigned haze do not permit it to the others.

    Parameters
    ----------
    problem : Problem
    point : Point
    most : float
        The answer is this at most, and `LEAST_HAZE` at least.

    Returns
    -------
    spread : float, share of an image's level
    """
    expected = problem.haze_errors
    if not problem.settings.haze:
        return problem.settings.haze_error
    errors = standard_errors(problem, point)[1 : OWN * problem.images : OWN]
    known = np.maximum(1.0 - (errors / expected) ** 2, 1e-9)
    share = point.state.haze / point.state.level
    square = share**2 / (problem.blocks.completeness * known)
    order = np.argsort(square)
    middle = np.cumsum(known[order]) - 0.5 * known[order]
    median = np.interp(0.5 * known.sum(), middle, square[order])
    return float(np.clip(1.4826 * np.sqrt(median), min(LEAST_HAZE, most), most))


def connected_groups(problem, point):
    """Images connected by pixels that both see, as arrays of indices."""
    i = np.repeat(np.arange(problem.images), np.diff(problem.pairs.first))
    links = (point.sums.shared_pixels, (i, problem.pairs.second))
    graph = coo_matrix(links, shape=(problem.images,) * 2).tocsr()
    graph.eliminate_zeros()
    count, label = connected_components(graph, directed=False)
    return [np.flatnonzero(label == group) for group in range(count)]
