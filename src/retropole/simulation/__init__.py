"""Simulated pairs of scans whose true transform is known."""

from .devices import Device, draw_device
from .insertion import InsertedPair, insert_poles
from .noise import EXACT, FIELD, NOISE_MODELS, TYPICAL, NoiseModel
from .pairs import SCENES, place_again, record_again, simulate_pair
from .raycast import Box, Cylinder, Material, Rectangle, Surface
from .recording import SimulatedPair, SimulationError
from .scanning import LabelledScan, scan
from .writing import write_pair

__all__ = [
    "EXACT",
    "FIELD",
    "NOISE_MODELS",
    "SCENES",
    "TYPICAL",
    "Box",
    "Cylinder",
    "Device",
    "InsertedPair",
    "LabelledScan",
    "Material",
    "NoiseModel",
    "Rectangle",
    "SimulatedPair",
    "SimulationError",
    "Surface",
    "draw_device",
    "insert_poles",
    "place_again",
    "record_again",
    "scan",
    "simulate_pair",
    "write_pair",
]
