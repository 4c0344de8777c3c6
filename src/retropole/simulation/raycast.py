"""Exact ray casting of planes, boxes and cylinders, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..base.datatypes import Array, IntArray


@dataclass(frozen=True)
class Material:
    """How a surface reflects the light of a LiDAR.

    Attributes
    ----------
    reflectance
        Diffuse reflectance, 0 to 1.
    retro
        Whether it is retro-reflective: returns near saturation at most angles of incidence.
    """

    reflectance: float = 0.4
    retro: bool = False


class Intersection(NamedTuple):
    """Range (N,) to a surface, infinite where a ray misses it, and cosine of incidence (N,)."""

    ranges: Array
    cosine: Array


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A flat rectangle.

    Attributes
    ----------
    centre
        (3,) metres.
    u, v
        (3,) unit vectors along its sides.
    half_sides
        Half of each side, metres.
    material
        Of its surface.
    """

    centre: Array
    u: Array
    v: Array
    half_sides: tuple[float, float]
    material: Material

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the centre that contains it, metres."""
        return float(np.hypot(*self.half_sides))

    def intersect(self, origin: Array, rays: Array, divergence: float) -> Intersection:
        """Intersect rays (N, 3) from an origin (3,) or (N, 3) with the surface."""
        normal = np.cross(self.u, self.v)
        cosine = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = ((self.centre - origin) @ normal) / cosine
            at = origin + ranges[:, None] * rays - self.centre
            hit = (ranges > 0) & (np.abs(at @ self.u) <= self.half_sides[0])
            hit &= np.abs(at @ self.v) <= self.half_sides[1]
        return Intersection(np.where(hit, ranges, np.inf), np.abs(cosine))


@dataclass(frozen=True, eq=False)
class Box:
    """A box.

    Attributes
    ----------
    centre
        (3,) metres.
    axes
        (3, 3) rotation whose columns are the directions of its sides.
    half_sides
        (3,) half of each side, metres.
    material
        Of its surface.
    """

    centre: Array
    axes: Array
    half_sides: Array
    material: Material

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the centre that contains it, metres."""
        return float(np.linalg.norm(self.half_sides))

    def intersect(self, origin: Array, rays: Array, divergence: float) -> Intersection:
        """Intersect rays (N, 3) from an origin (3,) or (N, 3) with the surface."""
        start, direction = (origin - self.centre) @ self.axes, rays @ self.axes
        with np.errstate(divide="ignore", invalid="ignore"):
            low = (-self.half_sides - start) / direction
            high = (self.half_sides - start) / direction
        enter = np.minimum(low, high)
        side = np.argmax(enter, axis=1)
        first = np.take_along_axis(enter, side[:, None], 1)[:, 0]
        last = np.maximum(low, high).min(axis=1)
        hit = (first > 0) & (first <= last)
        cosine = np.abs(np.take_along_axis(direction, side[:, None], 1)[:, 0])
        return Intersection(np.where(hit, first, np.inf), cosine)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder without end caps.

    Attributes
    ----------
    centre
        (3,) middle of its axis, metres.
    axis
        (3,) unit vector.
    radius, length
        Metres.
    material
        Of its surface.
    """

    centre: Array
    axis: Array
    radius: float
    length: float
    material: Material

    @property
    def bounding_radius(self) -> float:
        """Radius of a sphere about the centre that contains it and the edge of a beam, metres."""
        # The edge of a beam hits it too: half of 3 mrad, a common divergence, is 0.15 m at 100 m.
        return float(np.hypot(self.radius, self.length / 2)) + 0.2

    def intersect(self, origin: Array, rays: Array, divergence: float) -> Intersection:
        """Range (N,) to the surface, infinite for no hit, and cosine of incidence (N,).

        A beam with a divergence hits the cylinder if its centre line passes by less than half of
        the beam's width there. The range is then that of the closest approach.
        """
        start = origin - self.centre
        return meet(start, self.axis, rays, (self.radius, self.length), divergence)


def meet(
    start: Array, axis: Array, rays: Array, size: tuple[float, float], divergence: float
) -> Intersection:
    """Intersect rays with a cylinder, or each with a cylinder as it is at the time of the ray.

    Parameters
    ----------
    start
        (3,) or (N, 3) where the rays start, seen from the middle of the cylinder, metres.
    axis
        (3,) or (N, 3) unit vector of the cylinder.
    rays
        (N, 3) unit directions.
    size
        Radius and length of the cylinder, metres.
    divergence
        Full angle of the beams, rad.
    """
    radius, length = size
    ray_along, start_along = _dot(rays, axis), _dot(start, axis)
    ray_across = rays - ray_along[:, None] * axis
    start_across = start - start_along[..., None] * axis
    a, b = _dot(ray_across, ray_across), _dot(ray_across, start_across)
    c = _dot(start_across, start_across)
    with np.errstate(divide="ignore", invalid="ignore"):
        closest = -b / a
        distance = np.sqrt(np.maximum(c - b * b / a, 0.0))
        chord = np.sqrt(np.maximum(radius**2 - distance**2, 0.0) / a)
        ranges = closest - chord
        hit = distance <= radius + 0.5 * divergence * np.maximum(closest, 0.0)
        along = start_along + ranges * ray_along
        hit &= (ranges > 0) & (np.abs(along) <= length / 2)
        cosine = np.sqrt(np.maximum(1 - (distance / radius) ** 2, 0.0)) * np.sqrt(a)
    return Intersection(np.where(hit, ranges, np.inf), np.where(hit, cosine, 0.0))


def _dot(a: Array, b: Array) -> Array:
    """Scalar products of rows with rows, or of all rows with one vector."""
    return np.asarray(a @ b if b.ndim == 1 else np.einsum("...i,...i->...", a, b))


Surface = Rectangle | Box | Cylinder


class Hits(NamedTuple):
    """The first surface that each ray hits.

    Attributes
    ----------
    ranges
        (N,) metres; infinite where a ray hits nothing.
    surface
        (N,) index of the surface; −1 where a ray hits nothing.
    cosine
        (N,) of the angle of incidence.
    """

    ranges: Array
    surface: IntArray
    cosine: Array


def cast(origin: Array, rays: Array, surfaces: Sequence[Surface], divergence: float = 0.0) -> Hits:
    """Cast rays from one origin and find the nearest surface on each.

    Parameters
    ----------
    origin
        (3,) metres, in the frame of the surfaces.
    rays
        (N, 3) unit directions.
    surfaces
        Everything that a ray can hit.
    divergence
        Full angle of the beams, rad. Only cylinders, which may be thinner than a beam, use it.
    """
    ranges = np.full(len(rays), np.inf)
    surface = np.full(len(rays), -1, dtype=np.int64)
    cosine = np.zeros(len(rays))
    for k, body in enumerate(surfaces):
        toward = body.centre - origin
        distance = float(np.linalg.norm(toward))
        # Only rays inside the cone around the bounding sphere can hit.
        if distance > body.bounding_radius:
            cone = np.sqrt(1 - (body.bounding_radius / distance) ** 2)
            index = np.flatnonzero(rays @ (toward / distance) >= cone)
        else:
            index = np.arange(len(rays))
        if len(index) == 0:
            continue
        found, incidence = body.intersect(origin, rays[index], divergence)
        nearer = found < ranges[index]
        index = index[nearer]
        ranges[index], surface[index], cosine[index] = found[nearer], k, incidence[nearer]
    return Hits(ranges, surface, cosine)
