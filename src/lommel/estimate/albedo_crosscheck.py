"""How well an albedo map predicts images that had no part in it.

Most callers want `predict_left_out`.
"""

import numpy as np

from lommel.core.reflectance import reflectance_model
from lommel.estimate.albedo import estimate_albedo
from lommel.estimate.albedo_quality import modelled_brightness, predict_image
from lommel.estimate.albedo_samples import collect_samples


def predict_left_out(observations, grid, heights, settings, left_out):
    """Fit without some images, then predict these with only their own exposure and haze free.

    Parameters
    ----------
    observations : list of Observation
    grid : Grid
    heights : array (rows, cols), m
    settings : AlbedoSettings
    left_out : sequence of int
        Indices of the images to predict.

    Returns
    -------
    errors : dict of str to float
        For each image that meets the map, NMAD of (measured - predicted) / predicted over its used
        pixels; exposure and haze as `predict_image` fits them.
    """
    rest = [image for k, image in enumerate(observations) if k not in set(left_out)]
    result = estimate_albedo(rest, grid, heights, settings)
    model = reflectance_model(settings.reflectance)
    chosen = [observations[k] for k in left_out]
    samples, _, reasons = collect_samples(
        chosen, grid, heights, model, settings.masks, settings.slope_noise
    )
    names = [image.name for image, reason in zip(chosen, reasons, strict=True) if not reason]
    haze_error = settings.haze_error if settings.haze else 0.0
    errors = {}
    for k, name in enumerate(names):
        row, col, rows, cols = samples.windows[k]
        pixels = slice(samples.starts[k], samples.starts[k] + rows * cols)
        albedo = result.albedo[row : row + rows, col : col + cols].astype(float)
        modelled = albedo * modelled_brightness(samples, k, result.shared)
        used = (samples.weight[pixels].reshape(rows, cols) > 0) & (modelled > 0)
        measured = samples.measured[pixels].reshape(rows, cols).astype(float)
        if np.count_nonzero(used) > 1:
            errors[name] = predict_image(measured[used], modelled[used], haze_error)[2]
    return errors
