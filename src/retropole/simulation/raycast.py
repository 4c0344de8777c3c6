"""Exact ray casting of planes, boxes and cylinders, in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..datatypes import Array, IntArray


@dataclass(frozen=True)
class Material:
    """How a surface looks to a LiDAR.

    Attributes
    ----------
    reflectance
        Diffuse reflectance, 0 to 1.
    retro
        Whether it is retro-reflective: near saturation from most angles.
    """

    reflectance: float = 0.4
    retro: bool = False


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A flat rectangle: centre, two unit vectors along its sides, and half its sides in metres."""

    centre: Array
    u: Array
    v: Array
    half: tuple[float, float]
    material: Material

    @property
    def bound(self) -> float:
        """Radius of a sphere about the centre that holds it, metres."""
        return float(np.hypot(*self.half))

    def meet(self, origin: Array, rays: Array, divergence: float) -> tuple[Array, Array]:
        """Range (N,) to the surface, infinite where missed, and cosine of incidence (N,)."""
        normal = np.cross(self.u, self.v)
        cosine = rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            ranges = ((self.centre - origin) @ normal) / cosine
            at = origin + ranges[:, None] * rays - self.centre
            hit = (ranges > 0) & (np.abs(at @ self.u) <= self.half[0])
            hit &= np.abs(at @ self.v) <= self.half[1]
        return np.where(hit, ranges, np.inf), np.abs(cosine)


@dataclass(frozen=True, eq=False)
class Box:
    """A box: centre, axes as columns of a rotation (3, 3), and half its sides (3,) in metres."""

    centre: Array
    axes: Array
    half: Array
    material: Material

    @property
    def bound(self) -> float:
        """Radius of a sphere about the centre that holds it, metres."""
        return float(np.linalg.norm(self.half))

    def meet(self, origin: Array, rays: Array, divergence: float) -> tuple[Array, Array]:
        """Range (N,) to the surface, infinite where missed, and cosine of incidence (N,)."""
        start, direction = (origin - self.centre) @ self.axes, rays @ self.axes
        with np.errstate(divide="ignore", invalid="ignore"):
            low, high = (-self.half - start) / direction, (self.half - start) / direction
        enter = np.minimum(low, high)
        side = np.argmax(enter, axis=1)
        first = np.take_along_axis(enter, side[:, None], 1)[:, 0]
        last = np.maximum(low, high).min(axis=1)
        hit = (first > 0) & (first <= last)
        cosine = np.abs(np.take_along_axis(direction, side[:, None], 1)[:, 0])
        return np.where(hit, first, np.inf), cosine


@dataclass(frozen=True, eq=False)
class Cylinder:
    """A cylinder without caps: centre, unit axis, radius and length in metres."""

    centre: Array
    axis: Array
    radius: float
    length: float
    material: Material

    @property
    def bound(self) -> float:
        """Radius of a sphere about the centre that holds it, metres."""
        return float(np.hypot(self.radius, self.length / 2)) + 0.2

    def meet(self, origin: Array, rays: Array, divergence: float) -> tuple[Array, Array]:
        """Range (N,) to the surface, infinite where missed, and cosine of incidence (N,).

        A beam of some width returns from a cylinder that its middle misses by less than half of
        the width there; the range is then that of the closest part of the cylinder's edge.
        """
        start = origin - self.centre
        ray_along, start_along = rays @ self.axis, float(start @ self.axis)
        ray_across = rays - ray_along[:, None] * self.axis
        start_across = start - start_along * self.axis
        a = np.einsum("ni,ni->n", ray_across, ray_across)
        b = ray_across @ start_across
        c = float(start_across @ start_across)
        with np.errstate(divide="ignore", invalid="ignore"):
            closest = -b / a
            miss = np.sqrt(np.maximum(c - b * b / a, 0.0))
            chord = np.sqrt(np.maximum(self.radius**2 - miss**2, 0.0) / a)
            ranges = closest - chord
            hit = miss <= self.radius + 0.5 * divergence * np.maximum(closest, 0.0)
            along = start_along + ranges * ray_along
            hit &= (ranges > 0) & (np.abs(along) <= self.length / 2)
            cosine = np.sqrt(np.maximum(1 - (miss / self.radius) ** 2, 0.0)) * np.sqrt(a)
        return np.where(hit, ranges, np.inf), np.where(hit, cosine, 0.0)


Surface = Rectangle | Box | Cylinder


@dataclass(frozen=True, eq=False)
class Hits:
    """What each ray met first: range (infinite for nothing), surface (−1), cosine of incidence."""

    ranges: Array
    surface: IntArray
    cosine: Array


def cast(origin: Array, rays: Array, surfaces: Sequence[Surface], divergence: float = 0.0) -> Hits:
    """Cast rays from one origin and keep the nearest surface of each.

    Parameters
    ----------
    origin
        (3,) metres, in the frame of the surfaces.
    rays
        (N, 3) unit directions.
    surfaces
        What there is to hit.
    divergence
        Full angle of the beams, rad; it matters to cylinders only.
    """
    ranges = np.full(len(rays), np.inf)
    surface = np.full(len(rays), -1, dtype=np.int64)
    cosine = np.zeros(len(rays))
    for k, body in enumerate(surfaces):
        toward = body.centre - origin
        distance = float(np.linalg.norm(toward))
        # Only rays inside the cone about the bounding sphere can hit.
        if distance > body.bound:
            cone = np.sqrt(1 - (body.bound / distance) ** 2)
            rows = np.flatnonzero(rays @ (toward / distance) >= cone)
        else:
            rows = np.arange(len(rays))
        if len(rows) == 0:
            continue
        found, incidence = body.meet(origin, rays[rows], divergence)
        nearer = found < ranges[rows]
        rows = rows[nearer]
        ranges[rows], surface[rows], cosine[rows] = found[nearer], k, incidence[nearer]
    return Hits(ranges, surface, cosine)
