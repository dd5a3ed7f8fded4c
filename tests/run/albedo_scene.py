"""A simulated strip, small enough for every test of the albedo stage."""

from dataclasses import replace

from lommel.estimate.albedo_settings import AlbedoSettings
from lommel.run.inputs import SceneFiles

SMALL = """
seed = 7
[grid]
rows = 24
cols = 64
spacing = 8000.0
"""


def own_photometry():
    """The simulated ground scatters as its model says."""
    return AlbedoSettings(phase_factor=None, fit_phase_factor=False, fit_falloff=False)


def few_steps():
    """The same, stopped early: for tests that do not look at the answer."""
    return replace(own_photometry(), max_steps=4)


def files_of(ground, images=None):
    return SceneFiles(
        tuple(images or ground.images),
        (ground.initial_dem,),
        ground.sun_positions,
        ground.spacecraft_positions,
    )
