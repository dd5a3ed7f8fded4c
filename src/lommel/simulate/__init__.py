"""Scenes with a known answer, and images of them.

`settings` says what a scene holds, `terrain` makes the ground, `orbit` flies over it, `imaging`
takes the pictures. Most callers want `simulate_scene` and `preset`.
"""

from lommel.simulate.scene import Scene, SimulatedImage, simulate_scene
from lommel.simulate.settings import PRESETS, SceneSettings, preset

__all__ = ["PRESETS", "Scene", "SceneSettings", "SimulatedImage", "preset", "simulate_scene"]
