"""Scenes with known truth: a public simulator of sonar surveys."""

from sasmap.simulate.clip import SimulatedClip, coherent_cell, simulate_clip
from sasmap.simulate.load import load_scene
from sasmap.simulate.scene import Scene
from sasmap.simulate.straight import straight_clip
from sasmap.simulate.write import simulate

__all__ = [
    "Scene",
    "SimulatedClip",
    "coherent_cell",
    "load_scene",
    "simulate",
    "simulate_clip",
    "straight_clip",
]
