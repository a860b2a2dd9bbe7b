"""Scenes with known truth: a public simulator of sonar surveys."""

from sasmap.simulate.scene import Scene, load_scene
from sasmap.simulate.write import simulate

__all__ = ["Scene", "load_scene", "simulate"]
