"""Scenes with known truth: a public simulator of sonar surveys."""

from sasmap.simulate.clip import SimulatedClip, simulate_clip
from sasmap.simulate.scene import Scene, load_scene
from sasmap.simulate.straight import straight_clip
from sasmap.simulate.write import simulate

__all__ = ["Scene", "SimulatedClip", "load_scene", "simulate", "simulate_clip", "straight_clip"]
