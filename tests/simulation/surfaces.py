"""Surfaces at random poses, and how far points lie from them, without the ray caster."""

import numpy as np

from retropole.base import se3
from retropole.base.datatypes import Array
from retropole.simulation import Box, Cylinder, Material, Rectangle, Surface

DIFFUSE = Material()
KINDS = ("cylinder", "rectangle", "box")


def draw_surface(kind: str, rng: np.random.Generator) -> Surface:
    """Draw a surface of a metre or two, 6 m in front of the origin along x."""
    R = se3.random(rng)[:3, :3]
    centre = rng.uniform(-1, 1, 3) + np.array([6.0, 0.0, 0.0])
    if kind == "cylinder":
        return Cylinder(centre, R[:, 0], 0.4, 2.0, DIFFUSE)
    if kind == "rectangle":
        return Rectangle(centre, R[:, 0], R[:, 1], (1.5, 0.8), DIFFUSE)
    return Box(centre, R, np.array([0.7, 1.1, 0.4]), DIFFUSE)


def draw_rays(rng: np.random.Generator, count: int, spread: float) -> Array:
    """Draw unit rays (N, 3) around the x axis."""
    rays = np.array([1.0, 0.0, 0.0]) + rng.uniform(-spread, spread, (count, 3))
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def transformed(surface: Surface, T: Array) -> Surface:
    """Express a surface in another frame."""
    R, centre = T[:3, :3], se3.apply(T, surface.centre[None])[0]
    if isinstance(surface, Cylinder):
        return Cylinder(centre, R @ surface.axis, surface.radius, surface.length, DIFFUSE)
    if isinstance(surface, Rectangle):
        return Rectangle(centre, R @ surface.u, R @ surface.v, surface.half_sides, DIFFUSE)
    return Box(centre, R @ surface.axes, surface.half_sides, DIFFUSE)


def distance_from(surface: Surface, points: Array) -> Array:
    """Distance (N,) of points (N, 3) from a surface, by its definition."""
    if isinstance(surface, Cylinder):
        rel = points - surface.centre
        along = rel @ surface.axis
        radial = np.linalg.norm(np.cross(rel, surface.axis), axis=1) - surface.radius
        beyond = np.maximum(np.abs(along) - surface.length / 2, 0)
        return np.asarray(np.hypot(radial, beyond))
    if isinstance(surface, Rectangle):
        rel = points - surface.centre
        sides = np.stack([surface.u, surface.v])
        inside = np.clip(rel @ sides.T, -np.array(surface.half_sides), surface.half_sides)
        return np.asarray(np.linalg.norm(rel - inside @ sides, axis=1))
    outside = np.abs((points - surface.centre) @ surface.axes) - surface.half_sides
    return np.asarray(
        np.abs(np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0))
    )
