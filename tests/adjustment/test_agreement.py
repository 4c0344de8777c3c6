"""Poles that do not stand alike: which are left out in turn."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from retropole.adjustment import agreement
from retropole.adjustment.agreement import MOST_LEFT_OUT, without_misplaced
from retropole.alignment.adjustment import AxesTest
from retropole.base.errors import Refusal
from retropole.hypotheses.placements import PairedPlacement


class Paired:
    """A placement by its pairs alone."""

    def __init__(self, pairs: tuple[tuple[int, int], ...]) -> None:
        self.hypothesis = SimpleNamespace(match=SimpleNamespace(pairs=pairs))
        self.target_poles = pairs

    def without(self, pair: tuple[int, int]) -> "Paired":
        return Paired(tuple(each for each in self.target_poles if each != pair))


def aligned(chi2: float, by_pole: list[float]) -> Any:
    pose = SimpleNamespace(T_target_source=np.eye(4))
    return SimpleNamespace(pose=pose, axes_test=AxesTest(chi2, 4, np.array(by_pole)))


@pytest.mark.parametrize(("poles", "tries"), [(2, 0), (3, 3), (6, 6), (13, MOST_LEFT_OUT)])
def test_of_many_poles_the_worst_are_left_out(
    poles: int, tries: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_pole = [float(k) for k in np.random.default_rng(poles).permutation(poles)]
    tried: list[int] = []

    def align(paired: Any, T: Any, **_: float) -> Any:
        left = {k for k, _ in paired[0].target_poles}
        missing = set(range(poles)) - left
        tried.extend(missing)
        return aligned(1000.0, by_pole)

    every = Paired(tuple((k, k) for k in range(poles)))
    paired = [cast(PairedPlacement, every)]
    monkeypatch.setattr(agreement, "align", align)
    with pytest.raises(Refusal) as refused:
        without_misplaced(paired, aligned(1000.0, by_pole), radius=0.02, radius_sigma=0.0)
    assert refused.value.code == "poles_inconsistent"
    assert sorted(tried) == sorted(np.argsort(by_pole)[::-1][:tries])


def test_the_pole_that_mends_it_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = 4

    def align(paired: Any, T: Any, **_: float) -> Any:
        is_mended = all(k != moved for k, _ in paired[0].target_poles)
        return aligned(1.0 if is_mended else 1000.0, [1.0, 5.0, 2.0, 3.0, 9.0])

    every = Paired(tuple((k, k) for k in range(5)))
    paired: Any = [every]
    monkeypatch.setattr(agreement, "align", align)
    paired, _ = without_misplaced(paired, align(paired, None), radius=0.02, radius_sigma=0.0)
    assert paired[0].hypothesis.match.pairs == ((0, 0), (1, 1), (2, 2), (3, 3))
