"""One answer of a site from those of its pairs."""

from collections.abc import Iterable
from itertools import permutations

import pytest

from retropole.api.checking import CheckedPair, SiteCheck, verdict_of
from retropole.checking.movement import CheckResult, Status

ANSWERS: dict[str, Status] = {"=": "same", "x": "moved", "?": "cannot_tell"}


def verdict(pairs: str, lidars: Iterable[str]) -> SiteCheck:
    """Give the answer of pairs as ``a=b bxc``."""
    checked = [
        CheckedPair(each[0], each[2], CheckResult(ANSWERS[each[1]], ())) for each in pairs.split()
    ]
    return verdict_of(checked, list(lidars))


@pytest.mark.parametrize(
    ("pairs", "status", "moved", "untold"),
    [
        ("a=b b=c a=c", "same", "", ""),
        ("a=b b=c a?c", "same", "", ""),
        ("a=b b?c a?c", "cannot_tell", "", "c"),
        ("a=b bxc axc", "moved", "c", ""),
        ("a=b bxc a?c", "moved", "c", ""),
        # Two against two: nobody can tell which of them moved.
        ("a=b c=d axc bxd", "moved", "", ""),
        ("axb", "moved", "", ""),
        # Whoever stands with one that moved, moved with it.
        ("a=b b=c cxd d=e", "moved", "de", ""),
        # Of one that only they see which moved, nothing is known.
        ("a=b b=c cxd dxe", "moved", "d", "e"),
        ("a=b b=c cxd d?e", "moved", "d", "e"),
        ("a?b", "cannot_tell", "", "ab"),
        # Pairs that contradict each other.
        ("a=b b=c axc", "moved", "", ""),
    ],
)
def test_pairs_that_are_the_same_join_lidars_and_the_largest_group_stands(
    pairs: str, status: Status, moved: str, untold: str
) -> None:
    lidars = sorted({name for each in pairs.split() for name in (each[0], each[2])})
    for order in permutations(pairs.split()):
        answer = verdict(" ".join(order), lidars)
        assert answer.status == status
        assert answer.moved == tuple(moved)
        assert answer.untold == tuple(untold)


def test_a_lidar_in_no_pair_is_not_reported() -> None:
    answer = verdict("a=b", "abc")
    assert (answer.status, answer.untold) == ("cannot_tell", ("c",))
