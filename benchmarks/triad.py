"""What memory gives: the STREAM triad, and how near the solver's kernels come to it.

Bytes are those that a kernel has to move by its definition, each array once; reading a line of
the cache before it is written is not counted, neither here nor in the triad. Most callers want
`triad` and `kernels`.
"""

import time
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from lommel.core.multigrid import NormalEquations

# direction and three tensors in; solution and residual in and out; diagonal in; new direction out
SMOOTHING_BYTES = 40
REPEATS = 7  # of which the fastest counts: other programs only ever take time away


@dataclass(frozen=True)
class Speed:
    """How fast a kernel went.

    Attributes
    ----------
    name : str
    seconds : float
    posts : int
    bytes_per_post : float
        That it has to move.
    """

    name: str
    seconds: float
    posts: int
    bytes_per_post: float

    @property
    def bandwidth(self):
        """Bytes per second."""
        return self.bytes_per_post * self.posts / self.seconds


@njit(cache=True, parallel=True, fastmath=True)
def _triad(a, b, c, factor):
    for i in prange(a.shape[0]):
        x, y, z = a[i], b[i], c[i]
        for j in range(x.size):
            x[j] = y[j] + factor * z[j]


def fastest(function):
    """Seconds of the fastest of several calls, the first (which may compile) left out."""
    function()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def triad(posts=4096):
    """The `Speed` of ``a = b + f c`` on square float32 arrays."""
    a, b, c = (np.ones((posts, posts), np.float32) for _ in range(3))
    seconds = fastest(lambda: _triad(a, b, c, np.float32(2)))
    return Speed("triad", seconds, posts**2, 12)


def kernels(posts):
    """The `Speed` of one operator application and of one V-cycle.

    The operator reads the surface and three tensor planes and writes one plane: 20 bytes per post.
    A smoothing step also updates solution, residual and direction: 40 bytes (`SMOOTHING_BYTES`)
    if all is done while a row is at hand. A V-cycle of degree d has 2 d + 1 such steps per level.
    """
    rng = np.random.default_rng(0)
    slopes = rng.standard_normal((2, posts - 1, posts - 1), np.float32)
    tensors = (slopes[0] ** 2, slopes[0] * slopes[1], slopes[1] ** 2)
    equations = NormalEquations(tensors, np.full(3, 0.1, np.float32), [0.0, 0.0, 1e-3])
    steps = sum((2 * level.degree + 1) / 4**k for k, level in enumerate(equations.levels))
    u = rng.standard_normal((posts, posts), np.float32)
    out = np.empty_like(u)
    once = fastest(lambda: equations.levels[0].apply(u, out))
    cycle = fastest(lambda: equations.precondition(u))
    return [
        Speed("operator", once, posts**2, 20),
        Speed("V-cycle", cycle, posts**2, SMOOTHING_BYTES * steps),
    ]
