"""What the tests of sites ask of a simulated one."""

from retropole.base import se3
from retropole.simulation import SimulatedSite
from tests.simulation.surfaces import distance_from


def largest_distance(site: SimulatedSite, lidar: int, placement: int, pole: int) -> float:
    """How far the returns labelled as of a pole lie from where it stood first."""
    cloud, labels = site.clouds[lidar][placement], site.labels[lidar][placement]
    assert cloud is not None
    assert labels is not None
    own = cloud.xyz[labels == len(site.surroundings) + pole]
    world = se3.apply(site.T_world_lidar[lidar], own)
    return float(distance_from(site.poles[placement][pole], world).max(initial=0.0))


def everything(site: SimulatedSite) -> set[tuple[int, int, int]]:
    """LiDAR, placement and pole of what is seen."""
    return {
        (lidar, p, k)
        for p, views in enumerate(site.seen)
        for lidar, view in enumerate(views)
        for k, own in enumerate(view)
        if own
    }
