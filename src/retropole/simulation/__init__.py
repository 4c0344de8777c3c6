"""Simulated pairs of scans whose true transform is known."""

from .insertion import InsertedPair, insert_poles
from .pairs import (
    SCENES,
    SimulatedPair,
    SimulationError,
    place_again,
    record_again,
    simulate_pair,
)
from .raycast import Box, Cylinder, Material, Rectangle, Surface
from .scanning import EXACT, TYPICAL, LabelledScan, NoiseModel, scan
from .writing import write_pair

__all__ = [
    "EXACT",
    "SCENES",
    "TYPICAL",
    "Box",
    "Cylinder",
    "InsertedPair",
    "LabelledScan",
    "Material",
    "NoiseModel",
    "Rectangle",
    "SimulatedPair",
    "SimulationError",
    "Surface",
    "insert_poles",
    "place_again",
    "record_again",
    "scan",
    "simulate_pair",
    "write_pair",
]
