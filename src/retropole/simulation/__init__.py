"""Simulated pairs and sites whose true poses are known."""

from .devices import EXACT, FIELD, NOISE_MODELS, TYPICAL, Device, NoiseModel, draw_device
from .pairs import SCENES, SimulatedPair, SimulationError, place_again, simulate_pair
from .raycast import Box, Cylinder, Material, Rectangle, Surface
from .scanning import LabelledScan, scan
from .sites import SITES, SimulatedSite, Survey, simulate_site
from .walks import SimulatedWalk, simulate_walk
from .writing import write_pair, write_site, write_walk

__all__ = [
    "EXACT",
    "FIELD",
    "NOISE_MODELS",
    "SCENES",
    "SITES",
    "TYPICAL",
    "Box",
    "Cylinder",
    "Device",
    "LabelledScan",
    "Material",
    "NoiseModel",
    "Rectangle",
    "SimulatedPair",
    "SimulatedSite",
    "SimulatedWalk",
    "SimulationError",
    "Surface",
    "Survey",
    "draw_device",
    "place_again",
    "scan",
    "simulate_pair",
    "simulate_site",
    "simulate_walk",
    "write_pair",
    "write_site",
    "write_walk",
]
