"""The frames of a whole site as a tree: ``map`` → ``site`` → every LiDAR.

``site`` is the frame of the calibration, in metres on the ground, and small: what lies in it, a
viewer may hold in float32. ``map`` is written where the coordinates of the user's frame are others:
large ones, or those of a projected system. Then the large numbers are in one transform alone.
Where the LiDARs were leveled, ``site`` has ``ground`` too, and that the vehicle's
``base_footprint`` where this was measured.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..base import se3
from ..base.datatypes import Array
from ..base.description import Frame
from ..base.errors import UsageError, printable
from ..base.projection import Grid, grid_at
from ..base.se3 import joint_of, relative
from ..base.world import geodetic, site_in_frame, to_frame
from ..result import refusal_of, verdict_line
from ..result.site import LidarDoc, SiteDoc
from .transform import Found, Transform

if TYPE_CHECKING:
    from ..result.level import LevelDoc

MAP, SITE = "map", "site"
GROUND, BASE = "ground", "base_footprint"


@dataclass(frozen=True, eq=False)
class Tree:
    """The frames of a site.

    Attributes
    ----------
    name
        Of the site.
    datum
        What fixes its frame, in words.
    frame
        The frame of the site.
    lidars
        Of the document, in its order; each has a pose.
    verdict
        Of the calibration, on one line.
    joint
        (6 L, 6 L) covariance of all poses.
    edges
        The transforms, parents before children.
    """

    name: str
    datum: str
    frame: Frame
    lidars: tuple[LidarDoc, ...]
    verdict: str
    joint: Array
    edges: tuple[Transform, ...]

    @property
    def has_map(self) -> bool:
        """Whether the user's frame is another than that of the site's coordinates."""
        return self.edges[0].parent == MAP

    @property
    def lidar_edges(self) -> tuple[Transform, ...]:
        """The transforms of the LiDARs, in their order."""
        return self.edges[self.has_map :][: len(self.lidars)]

    @property
    def places(self) -> Array:
        """(L, 3) where the LiDARs are, in the frame of the site."""
        return np.array([edge.T_parent_child[:3, 3] for edge in self.lidar_edges])


def tree_of(document: SiteDoc, level: LevelDoc | None = None) -> Tree:
    """Make the tree of a site's frames, with those of its level.

    Raises
    ------
    Refusal
        If the site was refused: it has no poses.
    UsageError
        If a LiDAR is named as another frame is, or no frame can be named so.
    MissingExtraError
        If its frame is projected and pyproj is not installed.
    """
    if document.status == "refused":
        raise refusal_of(document.reasons, "the site was refused, there are no poses: ")
    frame = document.frame
    names = [lidar.name for lidar in document.lidars]
    for name in (MAP, SITE, *(GROUND, BASE) * (level is not None)):
        if name in names:
            raise UsageError(f"a LiDAR is named {name!r}, which is the name of a frame of the site")
    joint = np.array(document.joint_covariance, dtype=float)
    edges = [
        Transform(np.array(lidar.T_site_lidar, dtype=float), SITE, lidar.name, _own(joint, k))
        for k, lidar in enumerate(document.lidars)
    ]
    edges += [] if level is None else _leveled(level)
    if np.any(frame.offset) or (frame.epsg is not None and frame.geodetic is not None):
        edges.insert(0, Transform(site_in_frame(frame), MAP, SITE))
    verdict = verdict_line(document.status, document.reasons)
    lidars = tuple(document.lidars)
    return Tree(document.name, document.datum, frame, lidars, verdict, joint, tuple(edges))


def _leveled(level: LevelDoc) -> list[Transform]:
    """Give the ground in the site, and the vehicle on it where a LiDAR was measured on that."""
    edges = [Transform(se3.inverse(level.T_ground_frame), SITE, GROUND)]
    for lidar in level.lidars:
        if lidar.T_base_footprint_lidar is not None:
            T = lidar.T_ground_lidar @ se3.inverse(lidar.T_base_footprint_lidar)
            return [*edges, Transform(T, GROUND, BASE)]
    return edges


def _own(joint: Array, k: int) -> Array | None:
    """Covariance of one LiDAR; None for that whose frame is the site's."""
    own = joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
    return own if (np.diag(own) > 0).all() else None


def found_in_site(document: SiteDoc) -> list[Found]:
    """Give the transform between any two frames of a site, with the covariance of both together.

    What two LiDARs have in common cancels in it. ``map`` is treated as exact.

    Raises
    ------
    Refusal, UsageError, MissingExtraError
        As `tree_of`.
    """
    tree = tree_of(document)
    lidars = {lidar.name: k for k, lidar in enumerate(tree.lidars)}
    frames = {SITE: np.eye(4), **{edge.child: edge.T_parent_child for edge in tree.lidar_edges}}
    if tree.has_map:
        frames[MAP] = se3.inverse(tree.edges[0].T_parent_child)
    size = len(tree.joint)
    # The frames that are exact are last, with no variance.
    joint = np.zeros((size + 6, size + 6))
    joint[:size, :size] = tree.joint

    def between(parent: str, child: str) -> Found:
        i, j = (lidars.get(name, len(lidars)) for name in (parent, child))
        T, covariance = frames[parent], None
        pose = relative(T, frames[child], joint_of(joint, i, j))
        if (np.diag(pose.covariance) > 0).all():
            covariance = pose.covariance
        return Found(parent, child, lambda: pose.T_i_j, covariance, verdict=tree.verdict)

    return [between(a, b) for a in frames for b in frames if a != b]


def grid_of(tree: Tree) -> Grid | None:
    """What the projected system of a site does to lengths in its middle; None without one."""
    if tree.frame.epsg is None:
        return None
    (at,) = geodetic(tree.frame, tree.places.mean(axis=0, keepdims=True))
    return grid_at(tree.frame.epsg, at)


def notes_of(tree: Tree) -> list[str]:
    """Describe the frames, a line each, without line breaks.

    Of a projected system also what it does to lengths, and by how much the tree, which has the
    lengths of the ground, then differs from the coordinates in it.
    """
    frame = tree.frame
    notes = [
        f"site {tree.name}; its frame: {frame.name}; fixed by: {tree.datum}",
        tree.verdict,
    ]
    if frame.geodetic is not None:
        degrees = ", ".join(f"{angle:.9f}" for angle in np.degrees(frame.geodetic.array[:2]))
        of = "WGS 84" if frame.epsg is None else f"the datum of EPSG:{frame.epsg}"
        less = f", less {frame.offset.tolist()} m" if np.any(frame.offset) else ""
        notes.append(
            f"{SITE}: east, north, up{less}, metres on the ground, from latitude and longitude "
            f"{degrees} deg, height {frame.geodetic.height_m:.3f} m on the ellipsoid of {of}"
        )
    names = {edge.child for edge in tree.edges}
    if GROUND in names:
        notes.append(
            f"{GROUND}: on the ground below the LiDARs, z its normal, as 'retropole level' found it"
        )
    if BASE in names:
        notes.append(f"{BASE}: of the vehicle, on the ground (REP 120)")
    grid = grid_of(tree)
    if tree.has_map:
        system = frame.name if grid is None or frame.geodetic is None else grid.name
        notes.append(f"{MAP}: the frame of the survey ({system}), full coordinates")
    if grid is None:
        return [printable(note) for note in notes]
    notes += [grid.text, "heights are as surveyed, treated as heights above the ellipsoid"]
    if frame.geodetic is None:
        notes.append(
            f"{SITE}: coordinates of the grid less an offset: lengths are not those on the ground"
        )
    elif tree.has_map:
        by_tree = se3.apply(tree.edges[0].T_parent_child, tree.places)
        off = np.linalg.norm(by_tree - to_frame(frame, tree.places), axis=1)
        worst = int(off.argmax())
        # A tenth of a millimetre is below any survey.
        if off[worst] >= 1e-4:
            notes.append(
                f"the tree has lengths on the ground, so that in it {tree.lidars[worst].name} is "
                f"{1000 * off[worst]:.1f} mm from its coordinates in the grid; json and geojson "
                "contain the exact values"
            )
    return [printable(note) for note in notes]
