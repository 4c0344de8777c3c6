"""The tables of an answer, as the page and the terminal both show them: captions, headers, rows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ..adjustment.blunders import POOR
from ..base import se3
from ..base.datatypes import Array
from ..base.quantities import UNKNOWN, counted, error
from ..result import HypothesisDoc, InputDoc, PoleDoc, ResultDoc
from ..result.contents import RejectedDoc
from ..result.site import FoundDoc, PairDoc, SiteDoc
from .certainty import around, far_error, number, probability
from .subject import Subject, hypothesis_name, pair_name

POLE_COLUMNS = "pole; x, m; y, m; z, m; length, m; points; rings; rms, mm"

REJECTED_COLUMNS = "mark; code; reason; points; x, m; y, m; z, m"

DEGREES = 180 / np.pi


class Listing(NamedTuple):
    """A table: its caption, names of its columns, its rows, and which columns are words."""

    caption: str
    header: Sequence[str]
    rows: Sequence[Sequence[object]]
    words: Sequence[int] = ()

    def only(self, *columns: int) -> Listing:
        """Keep some columns."""
        rows = [[row[k] for k in columns] for row in self.rows]
        return Listing(self.caption, [self.header[k] for k in columns], rows)


def columns(names: str) -> list[str]:
    """Take names of columns apart that stand in one line, between semicolons."""
    return names.split("; ")


def pole_row(name: str, pole: PoleDoc) -> list[str]:
    """Write the figures of a pole, in the order of `POLE_COLUMNS`."""
    size = (number(pole.length_m, 2), str(pole.points), str(pole.rings))
    return [name, *numbers(pole.point_m, 3), *size, number(pole.rms_m, 1, 1000)]


def rejected_row(mark: str, cluster: RejectedDoc) -> list[str]:
    """Write why a cluster was rejected, in the order of `REJECTED_COLUMNS`."""
    said = (cluster.code, cluster.reason, str(cluster.points))
    return [mark, *said, *numbers(cluster.centre_m, 2)]


def numbers(values: Array, digits: int) -> list[str]:
    """Write several numbers with the same digits."""
    return [number(value, digits) for value in values]


def poles(subject: Subject, k: int) -> Listing:
    """List the poles that a LiDAR sees, of several placements with the one of each."""
    rows = [
        [*place, *pole_row(subject.pole(k, i), pole)]
        for place, each in _recorded(subject, k)
        for i, pole in enumerate(each.poles)
    ]
    return _of_placements(f"Poles in the frame of {subject.called(k)}", POLE_COLUMNS, rows, 1)


def rejected(subject: Subject, k: int) -> Listing:
    """List the rejected clusters of a LiDAR, each with its mark in the view and its reason."""
    rows = [
        [*place, *rejected_row(rejected_mark(k, i), cluster)]
        for place, each in _recorded(subject, k)
        for i, cluster in enumerate(each.rejected)
    ]
    return _of_placements(f"Rejected clusters of {subject.called(k)}", REJECTED_COLUMNS, rows, 3)


def _recorded(subject: Subject, k: int) -> Iterator[tuple[list[str], FoundDoc]]:
    """Give what was found in each recording of a LiDAR, with its placement where of several."""
    placements = subject.placements
    for place, each in zip(placements, subject.site.found[k], strict=True):
        if each is not None:
            yield [place] if len(placements) > 1 else [], each


def _of_placements(
    caption: str, names: str, rows: Sequence[Sequence[object]], words: int
) -> Listing:
    several = bool(rows) and len(rows[0]) > len(columns(names))
    header = columns(("placement; " if several else "") + names)
    return Listing(caption, header, rows, range(1, words + several))


def rejected_mark(lidar: int, k: int) -> str:
    """Write how the view marks the k-th rejected cluster of a LiDAR: ``× 3``, ``+ 0``."""
    return f"{'+' if lidar % 2 else '×'} {k}"


def found(subject: Subject) -> Listing:
    """Count what each LiDAR sees in each placement."""
    rows = [
        [lidar.name, *("not recorded" if each is None else _found(each) for each in of_lidar)]
        for lidar, of_lidar in zip(subject.site.lidars, subject.site.found, strict=True)
    ]
    header = ["LiDAR", *subject.placements]
    return Listing("Poles found in each placement", header, rows, range(1, len(header)))


def _found(each: FoundDoc) -> str:
    said = counted(len(each.poles), "pole")
    if each.rejected:
        said += f", {len(each.rejected)} rejected"
    return said if each.refusal is None else f"{said} ({each.refusal.code})"


def hypotheses(result: ResultDoc) -> Listing:
    """List the ways of laying the poles of a pair on each other, the best first."""
    rows = [
        [
            name_of(k, each),
            " ".join(map(pair_name, each.pairs)),
            "yes" if each.exact else "no",
            number(each.pole_rms_m, 1, 1000),
            number(each.icp_rotation_rad, 4),
            number(each.icp_translation_m, 4),
            number(each.overlap, 1, 100, " %"),
            number(each.free_space_violation, 1, 100, " %"),
            number(each.score, 3),
        ]
        for k, each in enumerate(result.hypotheses)
    ]
    names = "hypothesis; pairs; exact; pole rms, mm; e_r, rad; e_t, m; overlap; "
    header = columns(names + "free-space violation; score")
    return Listing("Hypotheses, best first", header, rows, (1,))


def name_of(k: int, hypothesis: HypothesisDoc) -> str:
    """Name the k-th hypothesis, and say that it is chosen."""
    return hypothesis_name(k) + (" · chosen" if hypothesis.chosen else "")


class PoseRow(NamedTuple):
    """Where a LiDAR is, in words; `sigma` is that of a point 30 m away, metres, None for none."""

    name: str
    x: str
    y: str
    z: str
    roll: str
    pitch: str
    yaw: str
    sigma: float | None


def pose_rows(site: SiteDoc) -> list[PoseRow]:
    """Write each pose in the frame's own coordinates, degrees; none where refused."""
    rows = []
    for lidar in site.lidars:
        if lidar.T_site_lidar is not None:
            R, t = lidar.T_site_lidar[:3, :3], lidar.T_site_lidar[:3, 3]
            x, y, z = numbers(t + site.frame.offset, 3)
            roll, pitch, yaw = numbers(np.degrees(se3.rpy_from_rotation(R)), 2)
            rows.append(PoseRow(lidar.name, x, y, z, roll, pitch, yaw, far_error(lidar)))
    return rows


def poses(site: SiteDoc) -> Listing:
    """List where the LiDARs are in the frame's own coordinates, each with its certainty."""
    asked = any(lidar.fitness is not None for lidar in site.lidars)
    rows = []
    for row, lidar in zip(pose_rows(site), site.lidars, strict=False):
        sigma = np.sqrt(np.maximum(np.diag(np.asarray(lidar.covariance))[3:], 0.0)).tolist()
        at = ", ".join(map(error, sigma)) if any(sigma) else UNKNOWN
        answer = [lidar.fitness.answer if lidar.fitness else UNKNOWN] if asked else []
        far = f"± {error(row.sigma)}" if row.sigma else UNKNOWN
        rows.append([*row[:7], far, at, *answer])
    names = "LiDAR; x, m; y, m; z, m; roll, °; pitch, °; yaw, °; 1 σ at 30 m; 1 σ of x, y, z"
    header = columns(names + "; good enough" * asked)
    return Listing(f"Poses of the LiDARs; frame: {site.frame.name}", header, rows)


def pairs(site: SiteDoc) -> Listing:
    """List the pairs, those with the largest w first."""
    refused = site.status == "refused"
    rows = [
        [
            " – ".join(site.lidars[k].name for k in pair.lidars),
            *(_size(pair.w, 1), pair.shared_poles, pair.patches or UNKNOWN),
            pair_words(pair, refused)
            + ("" if pair.refusal is None else f": {pair.refusal.message}"),
        ]
        for pair in sorted(site.pairs, key=lambda each: (-abs(each.w or 0.0), each.lidars))
    ]
    caption = "Pairs" if refused else "Pairs, the largest |w| first"
    header = columns("pair; |w|; shared poles; patches; the pair alone")
    return Listing(caption, header, rows, (4,))


def pair_words(pair: PairDoc, refused: bool) -> str:
    """Say what a pair alone has to say of its pose."""
    if pair.standing == 1:
        return "decides by itself"
    if pair.standing > 1:
        ways = counted(pair.standing, "way")
        return f"leaves {ways}" if refused else f"leaves {ways}, others decide"
    return "no answer of its own" if refused else "linked through others"


def loops(site: SiteDoc) -> Listing:
    """List by how much the pairwise poses around each loop fail to close."""
    rows = [
        [
            around(site, loop),
            number(loop.rotation, 3, DEGREES),
            number(loop.translation, 1, 1000),
            *(number(loop.chi2, 1), loop.freedom, probability(loop.probability)),
        ]
        for loop in sorted(
            site.loops, key=lambda each: 1.0 if each.probability is None else each.probability
        )
    ]
    header = columns("loop; rotation, deg; translation, mm; χ²; freedom; probability")
    return Listing("Misclosures, the least likely first", header, rows)


def tests(site: SiteDoc) -> Listing:
    """List the tests, the largest w first."""
    rows = [
        [
            *(test.name, test.kind, _size(test.w, 2), number(test.chi2, 1), test.freedom),
            number(test.redundancy, 0, 100, " %"),
            *(error(test.minimal_detectable), error(test.external)),
        ]
        for test in sorted(site.tests, key=lambda each: -abs(each.w or 0.0))
    ]
    names = "observation; kind; |w|; χ²; freedom; redundancy; smallest error found; effect at 30 m"
    return Listing("Tests, the largest |w| first", columns(names), rows, (1,))


def _size(w: float | None, digits: int) -> str:
    said = number(None if w is None else abs(w), digits)
    return said + (" stands out" if w is not None and abs(w) > POOR else "")


def changes(subject: Subject) -> Listing:
    """Say how the poses change without each placement."""
    site, pair = subject.site, subject.pair
    rows = [
        [
            subject.placement(each.placement),
            *([] if pair is None else [_both(pair, each.placement)]),
            number(each.rotation, 3, DEGREES),
            number(each.translation, 1, 1000),
            UNKNOWN if each.lidar is None else site.lidars[each.lidar].name,
        ]
        for each in site.without
    ]
    poles = "" if pair is None else "poles, target + source; "
    header = columns(f"without placement; {poles}rotation, deg; translation, mm; of LiDAR")
    caption = f"Change of the {'poses' if pair is None else 'pose'} without each placement"
    return Listing(caption, header, rows, (len(header) - 1,))


def _both(pair: ResultDoc, placement: int) -> str:
    each = pair.placements[placement]
    return f"{each.poles_target} + {each.poles_source}"


def left_out_words(document: InputDoc) -> str:
    """Say how many points and frames of too many were left out; nothing where none were."""
    parts = [
        counted(count, what)
        for count, what in ((document.thinned, "point"), (document.frames_left_out, "frame"))
        if count
    ]
    return f"{' and '.join(parts)} left out as too many" if parts else ""
