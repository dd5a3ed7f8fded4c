r"""Camera corrections from shifts between images and terrain, and among images.

A match says that what image a shows at a place on the map belongs `shift` away: on the terrain, or
at the place where image b shows it. Turning and moving a camera displaces what it shows at the
ground point X, whose image coordinates were p, by

.. math:: \delta(\theta) = -J^{-1} (P(\theta, X) - p)

on the map, with the projection P and its derivative J by map coordinates. The corrections minimise

.. math:: \sum \ln(1 + r^T \Sigma^{-1} r / c^2), \quad r = \delta_a - \delta_b - \text{shift}

(Cauchy's loss; c follows from the residuals) and stay within what pointing errors may be. They are
found by Gauss-Newton steps with weights renewed at each. Most callers want `adjust_cameras`.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve
from scipy.special import bdtrc

TERRAIN = -1  # in place of the second image
STEPS = 12
LEAST_SCALE = 1.0  # standard errors; residuals are never taken to be better than these say
MEDIAN_LENGTH = 1.1774  # of two normal errors of size 1
CAUCHY = 2.385  # of the scale: 95 % efficiency for normal errors
TURN, MOVE = 1e-6, 1.0  # rad, m; steps of the derivatives by parameters
NUDGE = 1.0  # m, of those by map coordinates


@dataclass(frozen=True, eq=False)
class Matches:
    """Shifts measured at places on the ground.

    Attributes
    ----------
    first, second : int array (n,)
        Numbers of the images; `TERRAIN` as the second for the terrain.
    xyz : array (n, 3), m, body-fixed
        Places, at the terrain's height.
    south, east : array (n, 3)
        Unit vectors along the map's rows and columns.
    shift : array (n, 2), m
        Along south and east.
    covariance : array (n, 2, 2), m^2
    """

    first: np.ndarray
    second: np.ndarray
    xyz: np.ndarray
    south: np.ndarray
    east: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray

    def __len__(self):
        """Number of matches."""
        return len(self.first)

    def of(self, chosen):
        """Those that an index or a mask picks."""
        return Matches(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))

    def renumbered(self, first, second):
        """The same between images of other numbers."""
        count = len(self)
        return replace(self, first=np.full(count, first), second=np.full(count, second))

    def left(self, residual):
        """What is left of the shifts after an adjustment with these residuals."""
        return replace(self, shift=-residual)


def join_matches(parts):
    """Several sets of matches as one."""
    names = Matches.__dataclass_fields__
    return Matches(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True)
class AdjustmentSettings:
    """What may change.

    Attributes
    ----------
    rotation_error : float, rad
        Standard error of the pointing, about each axis.
    position_error : float, m
        Of the position along each axis; 0 keeps it.
    """

    rotation_error: float = np.radians(1.0)
    position_error: float = 0.0

    @property
    def errors(self):
        """Of each parameter: three of the rotation, and three of the position if it is free."""
        count = 6 if self.position_error > 0 else 3
        return np.repeat([self.rotation_error, self.position_error], 3)[:count]


@dataclass(frozen=True, eq=False)
class Adjustment:
    """Corrections of the cameras.

    Attributes
    ----------
    rotation : array (images, 3), rad
        In the camera frames.
    move : array (images, 3), m, body-fixed
    residual : array (n, 2), m
        Of each match, along south and east.
    weight : array (n,)
        1 for a match that fits, towards 0 for one that does not.
    """

    rotation: np.ndarray
    move: np.ndarray
    residual: np.ndarray
    weight: np.ndarray


def adjust_cameras(cameras, matches, settings, start=None):
    """Corrections that bring images onto the terrain and onto each other.

    Parameters
    ----------
    cameras : list of Camera
    matches : Matches
    settings : AdjustmentSettings
    start : array (images, 6), optional
        Rotations (rad) and moves (m) that the cameras have had already: the errors allowed count
        from before them.

    Returns
    -------
    adjustment : Adjustment
    """
    errors = settings.errors
    count = errors.size
    before = np.zeros((len(cameras), count)) if start is None else start[:, :count]
    theta = np.zeros((len(cameras), count))
    whiten = whiten_matches(matches)
    jacobians = _map_jacobians(cameras, matches)
    for _ in range(STEPS):
        displaced, slopes = _displacements(cameras, matches, theta, jacobians)
        residual = displaced - matches.shift
        size = np.linalg.norm(np.einsum("nij,nj->ni", whiten, residual), axis=1)
        weight = _cauchy(size)
        step = _solve(matches, residual, slopes, weight, (theta + before) / errors, errors)
        theta += step
        if np.abs(step / errors).max() < 1e-6:
            break
    residual = _displacements(cameras, matches, theta, jacobians)[0] - matches.shift
    size = np.linalg.norm(np.einsum("nij,nj->ni", whiten, residual), axis=1)
    full = np.zeros((len(cameras), 6))
    full[:, :count] = theta
    return Adjustment(full[:, :3], full[:, 3:], residual, _cauchy(size))


def _cauchy(size):
    """Weights of residuals given in standard errors; their scale is that of the middle one."""
    if not size.size:
        return size
    scale = max(float(np.median(size)) / MEDIAN_LENGTH, LEAST_SCALE)
    return 1.0 / (1.0 + (size / (CAUCHY * scale)) ** 2)


def _sights(matches, number):
    """Matches in which an image takes part, and the sign of its displacement in them."""
    for members, sign in ((matches.first, 1.0), (matches.second, -1.0)):
        chosen = np.flatnonzero(members == number)
        if chosen.size:
            yield chosen, sign


def _map_jacobians(cameras, matches):
    """Inverse derivative of image coordinates by map coordinates, by image and sign."""
    found = {}
    for number, camera in enumerate(cameras):
        for chosen, sign in _sights(matches, number):
            xyz = matches.xyz[chosen]
            columns = [
                np.stack(camera.project(xyz + NUDGE / 2 * axis[chosen]), -1)
                - np.stack(camera.project(xyz - NUDGE / 2 * axis[chosen]), -1)
                for axis in (matches.south, matches.east)
            ]
            found[number, sign] = np.linalg.pinv(np.nan_to_num(np.stack(columns, -1) / NUDGE))
    return found


def _displacements(cameras, matches, theta, jacobians):
    """What corrections displace on the map, and its derivatives, by image and sign."""
    total = np.zeros((len(matches), 2))
    slopes = {}
    for number, camera in enumerate(cameras):
        for chosen, sign in _sights(matches, number):
            xyz, inverse = matches.xyz[chosen], jacobians[number, sign]
            before = np.stack(camera.project(xyz), -1)

            def displaced(parameters, camera=camera, xyz=xyz, before=before, inverse=inverse):
                after = np.stack(_corrected(camera, parameters).project(xyz), -1)
                return -np.einsum("nij,nj->ni", inverse, np.nan_to_num(after - before))

            total[chosen] += sign * displaced(theta[number])
            columns = []
            for index in range(theta.shape[1]):
                step = np.zeros(theta.shape[1])
                step[index] = TURN if index < 3 else MOVE
                columns.append(
                    (displaced(theta[number] + step) - displaced(theta[number] - step))
                    / (2 * step[index])
                )
            slopes[number, sign] = chosen, sign * np.stack(columns, -1)
    return total, slopes


def _corrected(camera, parameters):
    move = parameters[3:] if parameters.size > 3 else np.zeros(3)
    return camera.adjusted(parameters[:3], move)


def _solve(matches, residual, slopes, weight, prior, errors):
    """Gauss-Newton step of all images' parameters."""
    images, count = prior.shape
    root = whiten_matches(matches) * np.sqrt(weight)[:, None, None]
    entries = [(np.zeros(0), np.zeros(0, int), np.zeros(0, int))]
    for (number, _), (chosen, slope) in slopes.items():
        values = np.einsum("nij,njk->nik", root[chosen], slope * errors)
        row = np.broadcast_to(2 * chosen[:, None, None] + [[0], [1]], values.shape)
        col = np.broadcast_to(number * count + np.arange(count), values.shape)
        entries.append((values.ravel(), row.ravel(), col.ravel()))
    values, row, col = (np.concatenate(part) for part in zip(*entries, strict=True))
    jacobian = csr_array((values, (row, col)), shape=(2 * len(matches), images * count))
    gradient = prior.ravel() + jacobian.T @ np.einsum("nij,nj->ni", root, residual).ravel()
    normal = (jacobian.T @ jacobian + eye_array(images * count)).tocsc()
    return -spsolve(normal, gradient).reshape(images, count) * errors


def whiten_matches(matches):
    """Matrices (n, 2, 2) that turn residuals into standard errors."""
    return np.linalg.cholesky(np.linalg.inv(matches.covariance)).transpose(0, 2, 1)


def mean_error(matches):
    """Standard error of the mean shift, along one axis, m.

    Parameters
    ----------
    matches : Matches
        What an adjustment has left of them.

    Returns
    -------
    error : float, m
    """
    size = np.linalg.norm(np.einsum("nij,nj->ni", whiten_matches(matches), matches.shift), axis=1)
    scale = max(float(np.median(size)) / MEDIAN_LENGTH, LEAST_SCALE)
    information = _cauchy(size)[:, None, None] * np.linalg.inv(matches.covariance)
    covariance = scale**2 * np.linalg.inv(information.sum(axis=0))
    return float(np.sqrt(np.trace(covariance) / 2))


def chance_of_agreement(agreeing, tried, tolerance, reach):
    """Decimal logarithm of the odds that so many matches agree by chance.

    A match without relation has its peak anywhere in the search window, and so within the
    tolerance of a given place with the ratio of the areas.

    Parameters
    ----------
    agreeing, tried : int
    tolerance, reach : float, same unit
        Radius of agreement; half the side of the search window.

    Returns
    -------
    log10_chance : float

    Examples
    --------
    >>> chance_of_agreement(1, 1, 1.0, 5.0) > -2 > chance_of_agreement(5, 8, 1.0, 5.0)
    True
    """
    if tried == 0:
        return 0.0
    share = min(np.pi * tolerance**2 / (2.0 * reach) ** 2, 1.0)
    chance = bdtrc(agreeing - 1, tried, share) if agreeing > 0 else 1.0
    return float(np.log10(max(chance, 1e-300)))
