"""A refused report says what each LiDAR lacks, and the numbers hold."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from retropole.base import se3
from retropole.base.datatypes import Detection, Placement, RejectedCluster, Scan
from retropole.base.reasons import Code
from retropole.base.sensors import find_sensor
from retropole.extraction.acceptance_shape import MIN_POLE_POINTS, MIN_POLE_RINGS
from retropole.report.missing import missing_poles as missing_poles_of
from retropole.report.subject import of_pair
from retropole.result import ResultDoc
from retropole.simulation.devices import TYPICAL
from retropole.simulation.raycast import Cylinder
from retropole.simulation.scanning import scan
from retropole.simulation.scenes import TAPE
from tests.report.made_up import Page, made_up


def lacking(
    returns: int, away: float = 6.0, code: Code = "too_few_points"
) -> tuple[ResultDoc, Placement]:
    """A refused run whose source sees one pole, and a cluster where its second pole is."""
    result, (placement,) = made_up("refused", 500)
    source = placement.source
    assert source.detection is not None
    first, second = source.detection.poles
    rejected = RejectedCluster(second.index[:returns], second.point, code, "the reason")
    detection = replace(source.detection, poles=(first,), rejected=(rejected,))
    # The beams start where the cluster is so far away as asked for.
    origin = second.point - away * np.array([1.0, 0.0, 0.0])
    scan = replace(source, detection=detection, cloud=replace(source.cloud, origin=origin))
    return result, replace(placement, source=scan)


def missing_poles(result: ResultDoc, placements: Sequence[Placement]) -> str:
    return missing_poles_of(of_pair(result, placements))


def text_of(result: ResultDoc, *placements: Placement) -> str:
    return Page(missing_poles(result, placements)).text


def test_it_says_how_many_returns_are_missing_and_how_much_nearer_they_are() -> None:
    text = text_of(*lacking(4))
    assert "The source sees 1 of 2 poles" in text
    assert "Pole S0" in text
    assert "60 returns on 9 rings" in text
    assert "4 returns, 6 are needed: if it is your pole, stand it 2.0 m nearer." in text
    assert "The target sees" not in text


def test_what_is_too_little_to_go_by_gives_no_number() -> None:
    text = text_of(*lacking(1))
    assert "1 return, 6 are needed: if it is your pole, stand it much nearer." in text


def test_rings_are_counted_where_the_cloud_has_them() -> None:
    result, placement = lacking(8, 9.0, "too_few_rows")
    cloud = placement.source.cloud
    assert "the reason" in text_of(result, placement)
    rings = np.arange(len(cloud)) % 2
    with_rings = replace(placement.source, cloud=replace(cloud, ring=rings))
    text = text_of(result, replace(placement, source=with_rings))
    assert "on 2 rings, 3 are needed: if it is your pole, stand it 3.0 m nearer." in text


def test_other_reasons_come_with_their_advice() -> None:
    text = text_of(*lacking(8, code="part_of_a_surface"))
    assert "the reason. If it is your pole, it stands too near a wall" in text


def test_a_cluster_that_stands_elsewhere_is_not_named() -> None:
    result, placement = lacking(4)
    detection = placement.source.detection
    assert detection is not None
    (cluster,) = detection.rejected
    elsewhere = replace(cluster, centre=cluster.centre + np.array([9.0, 9.0, 0.0]))
    moved = replace(placement.source, detection=replace(detection, rejected=(elsewhere,)))
    text = text_of(result, replace(placement, source=moved))
    assert "4 returns" not in text
    assert "None of the 1 rejected clusters fits that." in text
    assert "below the threshold of 200" in text
    nothing = replace(placement.source, detection=replace(detection, rejected=()))
    assert "Nothing else is as bright as tape." in text_of(
        result, replace(placement, source=nothing)
    )


def test_without_a_pole_the_clusters_of_which_little_was_seen_come_first() -> None:
    result, placement = lacking(4)
    detection = placement.source.detection
    assert detection is not None
    (few,) = detection.rejected
    others = tuple(replace(few, code="too_wide", reason=f"wide {k}") for k in range(5))
    blind = replace(detection, poles=(), rejected=(*others, few))
    text = text_of(result, replace(placement, source=replace(placement.source, detection=blind)))
    assert "The source sees 0 of 2 poles" in text
    assert text.index("4 returns") < text.index("wide 0")
    assert "3 more bright clusters" in text


def test_nothing_is_said_where_nothing_is_missing_or_nobody_looked() -> None:
    result, (placement,) = made_up("refused", 500)
    assert missing_poles(result, [placement]) == ""
    unseen = Placement(Scan(placement.target.cloud), Scan(placement.source.cloud))
    assert missing_poles(result, [unseen]) == ""
    answered, placements = made_up("ok", 500)
    assert missing_poles(answered, placements) == ""
    asked = msgspec.structs.replace(result, config=msgspec.structs.replace(result.config, poles=3))
    assert text_of(asked, placement).count("2 of 3 poles") == 2
    assert "in placement 2" in text_of(asked, placement, placement)


@pytest.mark.parametrize("name", ["VLP-16", "PandarQT"])
def test_so_much_nearer_a_pole_has_as_many_returns_and_rings_as_are_needed(name: str) -> None:
    """What the page promises, against rays that are cast on a pole from both distances."""
    rng, sensor = np.random.default_rng(4), find_sensor(name)

    def mean_seen(distance: float) -> tuple[float, float]:
        pole = Cylinder(
            np.array([distance, 0.0, 0.0]), np.array([0.0, 0.17, 0.98]), 0.02, 1.0, TAPE
        )
        seen = []
        for _ in range(30):
            turned = se3.from_rt(se3.exp_so3(np.r_[0.05 * rng.normal(size=2), 1.0]), np.zeros(3))
            cloud = scan([pole], sensor, turned, rng, TYPICAL).cloud
            assert cloud.ring is not None
            seen.append((len(cloud), len(np.unique(cloud.ring))))
        points, rings = np.mean(seen, axis=0)
        return float(points), float(rings)

    far = 16.0
    points, rings = mean_seen(far)
    assert points < MIN_POLE_POINTS
    assert mean_seen(far * points / MIN_POLE_POINTS)[0] >= MIN_POLE_POINTS
    if rings < MIN_POLE_RINGS:
        nearer = mean_seen(far * rings / MIN_POLE_RINGS)[1]
        assert nearer == pytest.approx(MIN_POLE_RINGS, rel=0.15)


def test_names_in_it_are_escaped() -> None:
    result, placement = lacking(8, code="too_wide")
    detection = placement.source.detection
    assert detection is not None
    (cluster,) = detection.rejected
    hostile: Detection = replace(detection, rejected=(replace(cluster, reason="<b>&"),))
    html = missing_poles(
        result, [replace(placement, source=replace(placement.source, detection=hostile))]
    )
    assert re.search("&lt;b&gt;&amp;", html)
