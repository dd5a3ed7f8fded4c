"""How albedo and exposures are estimated. Most callers want `AlbedoSettings`."""

from dataclasses import dataclass, field, replace

from lommel.errors import InputError
from lommel.estimate.albedo_rows import LOSSES
from lommel.scene.masks import MaskSettings

SOLVERS = ("projection", "alternating")
PHASE_START = (1.383488, 0.501149)  # c1 per rad, c2: lunar values of the Ames photometry toolkit


@dataclass(frozen=True)
class AlbedoSettings:
    """How albedo and exposures are estimated.

    Attributes
    ----------
    reflectance : str
        Name of a reflectance model.
    solver : {'projection', 'alternating'}
        Albedo eliminated, or the published iteration.
    loss : {'cauchy', 'huber', 'least-squares'}
    haze : bool
        Estimate an offset per image.
    phase_factor : (c1, c2) or None
        Multiplies the reflectance by exp(-c1 phase) + c2, phase in rad; None and (0, 0) by 1.
    fit_phase_factor : bool
        Estimate c1 and c2, starting from ``phase_factor``.
    fit_falloff : bool
        Estimate the lens falloff, v2 and v4 about 0.
    slope_noise : float, rad, or None
        Slope error of the DEM per relative error of brightness; None weighs all pixels alike.
    albedo_contrast : float
        Expected standard deviation of the logarithm of mean albedo from image to image.
    haze_error : float
        Largest standard deviation of haze from image to image, as a share of the image's level.
    masks : MaskSettings
    max_steps : int
        Of the default solver on cells of the images; of the alternating one each is a pass.
    tolerance : float
        The iteration ends when the cost falls by less than this share in one step.
    """

    reflectance: str = "lunar-lambert"
    solver: str = "projection"
    loss: str = "cauchy"
    haze: bool = True
    phase_factor: tuple[float, float] | None = PHASE_START
    fit_phase_factor: bool = True
    fit_falloff: bool = True
    slope_noise: float | None = 0.5
    albedo_contrast: float = 0.075
    haze_error: float = 0.1
    masks: MaskSettings = field(default_factory=MaskSettings)
    max_steps: int = 200
    tolerance: float = 1e-5


def published_settings(**changes):
    """The albedo paper as printed: alternating updates, least squares, nothing else fitted."""
    paper = AlbedoSettings(
        reflectance="lunar-lambert-exponential",
        solver="alternating",
        loss="least-squares",
        haze=False,
        phase_factor=None,
        fit_phase_factor=False,
        fit_falloff=False,
        slope_noise=None,
        max_steps=100,
    )
    return replace(paper, **changes)


def check_settings(settings):
    """Raise InputError for a value that cannot be meant."""
    if settings.solver not in SOLVERS:
        raise InputError(
            f"solver = {settings.solver!r} is unknown. Choose one of {', '.join(SOLVERS)}."
        )
    if settings.loss not in LOSSES:
        raise InputError(f"loss = {settings.loss!r} is unknown. Choose one of {', '.join(LOSSES)}.")
    for name in ("albedo_contrast", "haze_error", "tolerance", "max_steps"):
        value = getattr(settings, name)
        if not value > 0:
            raise InputError(f"{name} = {value} is not positive. Give a number above 0.")
    threshold = settings.masks.shadow_threshold
    if threshold is not None and not threshold >= 0:
        raise InputError(
            f"shadow_threshold = {threshold} is negative. It is the image value up to which a "
            "pixel counts as shadow; give 0 or more."
        )
