"""`detect` finds what `calibrate` uses."""

import numpy as np
import pytest

import retropole as rp
from tests.api.clouds import calibrated, pair, tables


def test_poles_are_those_of_a_calibration() -> None:
    found = rp.detect(tables().target)
    listed = [pole.point_m for pole in calibrated().document.poles.target]
    np.testing.assert_array_equal([pole.point for pole in found.poles], listed)


def test_options_are_taken() -> None:
    assert rp.detect(pair().target, sensor="VLP-16").threshold_source.startswith("VLP-16; falls to")
    assert rp.detect(pair().target, threshold=1e9).poles == ()
    with pytest.raises(rp.UsageError, match="nonsense"):
        rp.detect(pair().target, sensor="nonsense")


def test_without_intensity_it_is_refused_and_says_what_to_give() -> None:
    with pytest.raises(rp.Refusal, match=r"\(N, 4\)") as caught:
        rp.detect(tables().target[:, :3])
    assert caught.value.code == "no_intensity"
    with pytest.raises(rp.Refusal) as caught:
        rp.detect(rp.PointCloud(tables().target[:, :3]))
    assert "(N, 4)" not in str(caught.value)
