r"""One compiled pass over all images of the albedo problem.

`accumulate` visits every image pixel once and leaves the best albedo for the given image parameters
and the sums of one Gauss-Newton step on those parameters, albedo eliminated. With the modelled
brightness :math:`A_{ij} M^k_{ij} + b^k`,

.. math:: M = T R (e^{-c_1 \alpha} + c_2) e^{-v_2 \theta^2 - v_4 \theta^4}

.. math:: A = \frac{\sum_k w M (I - b)}{\sum_k w M^2}, \qquad
          H = \sum w J^T J - \sum_{ij} \frac{(\sum_k w M J)^T (\sum_k w M J)}{\sum_k w M^2}

where J are the derivatives of the brightness by the image parameters (log exposure, haze in units
of the image's level) and by the shared ones (c1, c2, v2, v4). Loops run along rows of the grid;
sums are kept per block of rows, so that results do not depend on the number of threads.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from lommel.estimate.albedo_arrays import (
    OWN,
    PATCHES,
    SHARED,
    Pairs,
    State,
    Work,
    empty_maps,
    empty_sums,
)
from lommel.estimate.albedo_rows import (
    LEAST_SQUARES,
    brightness_row,
    count_row,
    dot3,
    image_sums,
    inner,
    mean_sums,
    residual_sums,
    shared_sums,
    weigh_row,
)

SWEEPS = 5  # weightings of the pixels of a post; the robust mean then moves below 1e-3 of its error


@inner
def _first_sweep(row, here, samples, images, state, is_step, work, maps):
    """Brightness of every image in this row, and how many there are."""
    count, freedom = maps.image_count[here], maps.freedom[here]
    count[:], freedom[:] = 0, 0.0
    for a in range(images.size):
        k = images[a]
        first, width, part = _place(samples, k, row)
        cols = slice(first, first + width)
        brightness_row(
            samples.reflectance[part],
            samples.phase[part],
            samples.off_axis[part],
            state.exposure[k],
            state.shared,
            is_step,
            work.brightness[a, :width],
            work.derivatives[a, :, :width],
        )
        count_row(samples.weight[part], count[cols], freedom[cols])
    for j in range(count.size):
        if count[j] > 0:
            freedom[j] *= (count[j] - 1) / count[j]


@inner
def _best_albedo(row, here, samples, images, state, scale, loss, work, maps):
    """Albedo of this row by repeated weighting, from the plain weighted mean on.

    It depends on the image parameters alone, not on the pass before, so that the cost is a function
    of these parameters.
    """
    albedo, bottom, spread = maps.albedo[here], maps.information[here], maps.spread[here]
    for sweep in range(1 if loss == LEAST_SQUARES else SWEEPS):
        work.top[:], bottom[:], spread[:] = 0.0, 0.0, 0.0
        for a in range(images.size):
            k = images[a]
            first, width, part = _place(samples, k, row)
            cols = slice(first, first + width)
            weigh_row(
                samples.measured[part],
                samples.weight[part],
                samples.precision[part],
                work.brightness[a, :width],
                state.haze[k],
                albedo[cols],
                scale,
                loss if sweep > 0 else LEAST_SQUARES,
                work.w[a, :width],
                work.top[cols],
                bottom[cols],
                spread[cols],
            )
        for j in range(albedo.size):
            work.inverse[j] = 1.0 / bottom[j] if bottom[j] > 0.0 else 0.0
            albedo[j] = work.top[j] * work.inverse[j]


@inner
def _second_sweep(row, here, samples, images, state, scale, loss, is_step, work, sums, maps):
    """Sums of every image in this row, given the albedo."""
    albedo, scatter, count = maps.albedo[here], maps.scatter[here], maps.image_count[here]
    work.u_shared[:] = 0.0
    scatter[:] = 0.0
    for a in range(images.size):
        k = images[a]
        first, width, part = _place(samples, k, row)
        cols = slice(first, first + width)
        measured, weight = samples.measured[part], samples.weight[part]
        brightness, w = work.brightness[a, :width], work.w[a, :width]
        residual = work.residual[:width]
        for j in range(width):
            residual[j] = albedo[first + j] * brightness[j] + state.haze[k] - measured[j]
        if is_step:
            derivatives = work.derivatives[a, :, :width]
            image_sums(
                brightness,
                derivatives,
                w,
                albedo[cols],
                residual,
                state.level[k],
                sums.own[k],
                sums.border[k],
                sums.gradient[k],
                work.u[a, :, :width],
            )
            shared_sums(
                brightness,
                derivatives,
                w,
                albedo[cols],
                residual,
                sums.square,
                sums.shared_gradient,
                work.u_shared[:, cols],
            )
            mean_sums(measured, weight, brightness, derivatives, sums.means[k])
        patch = (row - samples.windows[k, 0]) * PATCHES // samples.windows[k, 2]
        cost, score_square = residual_sums(
            residual,
            weight,
            samples.precision[part],
            w,
            count[cols],
            scale,
            loss,
            scatter[cols],
            sums.histogram,
            sums.patches[k, patch],
        )
        sums.cost[0] += cost
        sums.score_square[0] += score_square


@inner
def _eliminate(samples, images, pairs, place_of, work, sums):
    """Subtract what the albedo takes up: products of w M J over every pair of images."""
    for g in range(SHARED):
        for h in range(g, SHARED):
            sums.square[g, h] -= dot3(work.u_shared[g], work.u_shared[h], work.inverse)
    for a in range(images.size):
        i = images[a]
        first, width = samples.windows[i, 1], samples.windows[i, 3]
        cols = slice(first, first + width)
        for p in range(OWN):
            for g in range(SHARED):
                sums.border[i, p, g] -= dot3(
                    work.u[a, p, :width], work.u_shared[g, cols], work.inverse[cols]
                )
        for pair in range(pairs.first[i], pairs.first[i + 1]):
            j = pairs.second[pair]
            b = place_of[j]
            if b < 0:
                continue
            low = max(first, samples.windows[j, 1])
            high = min(first + width, samples.windows[j, 1] + samples.windows[j, 3])
            if low >= high:
                continue
            inverse = work.inverse[low:high]
            for p in range(OWN):
                ui = work.u[a, p, low - first : high - first]
                for q in range(OWN):
                    start = low - samples.windows[j, 1]
                    uj = work.u[b, q, start : start + high - low]
                    sums.pairs[pair, p, q] += dot3(ui, uj, inverse)
            sums.shared_pixels[pair] += _seen_by_both(work, a, b, low, high, first, samples, j)


@inner
def _seen_by_both(work, a, b, low, high, first, samples, j):
    total = 0.0
    for col in range(low, high):
        total += (work.w[a, col - first] > 0.0) & (work.w[b, col - samples.windows[j, 1]] > 0.0)
    return total


@inner
def _place(samples, k, row):
    """First column, width and flat slice of image k in this row of the grid."""
    first, width = samples.windows[k, 1], samples.windows[k, 3]
    start = samples.starts[k] + (row - samples.windows[k, 0]) * width
    return first, width, slice(start, start + width)


@inner
def _images_in(row, samples, place_of):
    """Images whose window holds this row; ``place_of`` receives their place in the list."""
    images = np.empty(samples.starts.size, np.int64)
    count = 0
    for k in range(samples.starts.size):
        place_of[k] = -1
        if samples.windows[k, 0] <= row < samples.windows[k, 0] + samples.windows[k, 2]:
            images[count] = k
            place_of[k] = count
            count += 1
    return images[:count]


@inner
def _most_images(first_row, last_row, samples):
    """Largest number of images in one row of the block."""
    change = np.zeros(last_row - first_row + 1, np.int64)
    for k in range(samples.starts.size):
        low = max(samples.windows[k, 0], first_row)
        high = min(samples.windows[k, 0] + samples.windows[k, 2], last_row)
        if low < high:
            change[low - first_row] += 1
            change[high - first_row] -= 1
    return np.cumsum(change).max()


@inner
def _work_for(images, widest, cols):
    return Work(
        np.zeros((images, widest)),
        np.zeros((images, SHARED, widest)),
        np.zeros((images, widest)),
        np.zeros((images, OWN, widest)),
        np.zeros((SHARED, cols)),
        np.zeros(cols),
        np.zeros(cols),
        np.zeros(cols),
    )


@njit(cache=True, error_model="numpy", nogil=True)
def _visit_rows(first_row, last_row, samples, pairs, state, scale, loss, is_step, maps, sums):
    widest = np.max(samples.windows[:, 3])
    work = _work_for(_most_images(first_row, last_row, samples), widest, maps.albedo.shape[1])
    place_of = np.empty(samples.starts.size, np.int64)
    for row in range(first_row, last_row):
        images, here = _images_in(row, samples, place_of), row - first_row
        _first_sweep(row, here, samples, images, state, is_step, work, maps)
        _best_albedo(row, here, samples, images, state, scale, loss, work, maps)
        _second_sweep(row, here, samples, images, state, scale, loss, is_step, work, sums, maps)
        if is_step:
            _eliminate(samples, images, pairs, place_of, work, sums)


@dataclass(frozen=True, eq=False)
class Visitor:
    """Visits every pixel of a block of rows once, with the image parameters as they are.

    Attributes
    ----------
    blocks : SampleBlocks or Cells
    pairs : Pairs
    state : State
        Image parameters and shared parameters.
    scale : float
        Standard error of a residual times the root of its precision.
    loss : int
        LEAST_SQUARES, HUBER or CAUCHY.
    is_step : bool
        Whether what a Gauss-Newton step needs is summed as well; else only residuals are, in
        half to two thirds of the time.
    """

    blocks: object
    pairs: Pairs
    state: State
    scale: float
    loss: int
    is_step: bool = True

    def visit(self, block):
        """Samples of a block, its `Maps` with the best albedo, and its `Sums`."""
        first, last = self.blocks.span(block)
        samples = self.blocks.block(block)
        maps = empty_maps((last - first, self.blocks.shape[1]))
        sums = empty_sums(len(self.blocks.windows), len(self.pairs.second))
        terms = samples, self.pairs, self.state, self.scale, self.loss, self.is_step
        _visit_rows(first, last, *terms, maps, sums)
        return samples, maps, sums

    def __call__(self, block):
        """Sums of a block."""
        return self.visit(block)[2]


def accumulate(visitor, every=1):
    """Visit every pixel once: best albedo, then the sums of a Gauss-Newton step.

    Parameters
    ----------
    visitor : Visitor
    every : int
        Only each so manieth block of rows.

    Returns
    -------
    sums : Sums
        Of the blocks in their order, so that they do not depend on the threads.
    """
    total = empty_sums(len(visitor.blocks.windows), len(visitor.pairs.second))
    for sums in visitor.blocks.each(visitor, every=every):
        for whole, part in zip(total, sums, strict=True):
            whole += part
    return total
