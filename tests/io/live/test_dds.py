"""Topics of ROS 2 by DDS: publishers are processes of their own, messages are made by rosbags."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from retropole.base.errors import ReadError, UsageError
from retropole.io import Frame
from tests.io.live import publishing
from tests.paths import ROOT

pytest.importorskip("cyclonedds")

from retropole.io.live.dds import DdsSource, dds_name, domain_or_default

pytestmark = pytest.mark.full

DOMAIN = 10 + os.getpid() % 200
"""Tests that run at once do not hear each other."""


@contextmanager
def published(topic: str, *options: str, seconds: float = 30.0) -> Iterator[None]:
    command = [sys.executable, "-m", "tests.io.live.publishing", topic, str(seconds)]
    command += ["--domain", str(DOMAIN), "--interface", "lo", *options]
    process = subprocess.Popen(command, cwd=ROOT)
    try:
        yield
    finally:
        process.kill()
        process.wait()


def source_of(topic: str) -> DdsSource:
    return DdsSource(topic, domain=DOMAIN, interface="lo")


def first(source: DdsSource, wanted: Callable[[Frame], bool] = lambda frame: True) -> Frame:
    """Wait for a sweep; what cannot be read is passed over."""
    for _ in range(600):
        try:
            frame = source.newest(0.1)
        except ReadError:
            continue
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError(source.waits_for)


@pytest.mark.parametrize("layout", publishing.LAYOUTS)
@pytest.mark.parametrize("reliability", [(), ("--best-effort",)], ids=["reliable", "best-effort"])
def test_layouts_of_drivers_come_as_they_were_sent(
    layout: str, reliability: tuple[str, ...]
) -> None:
    source = source_of("front/points")
    sent = publishing.noise(5000, 0), publishing.noise(5000, 1), publishing.noise(5000, 2)
    with published("/front/points", "--layout", layout, "--points", "5000", *reliability):
        frame = first(source)
        assert source.waits_for == ""
    source.close()
    cloud = frame.cloud
    own = next(s for s in sent if np.allclose(s["x"][0], cloud.xyz[0, 0], atol=1e-4))
    for axis, name in enumerate("xyz"):
        np.testing.assert_allclose(cloud.xyz[:, axis], own[name], atol=1e-5)
    assert cloud.intensity is not None
    np.testing.assert_allclose(cloud.intensity, own["intensity"], atol=1e-5)
    np.testing.assert_array_equal(cloud.ring, own["ring"])
    assert frame.frame_id == "lidar"
    assert frame.stamp == pytest.approx(time.time(), abs=60)
    assert cloud.notes == ()


def test_what_is_there_is_named() -> None:
    wrong = source_of("/rear/points")
    assert "is not published" in wrong.waits_for
    with published("/front/points", "--points", "100"):
        right = source_of("/front/points")
        first(right)
        assert "clouds are on: /front/points" in wrong.waits_for
    wrong.close()
    right.close()


def test_a_publisher_that_dies_is_missed() -> None:
    """Those who listen give it ten seconds."""
    right = source_of("/front/points")
    with published("/front/points", "--points", "100"):
        first(right)
    for _ in range(200):
        with pytest.MonkeyPatch.context() as patch:
            # Sweeps are missed once they have not come for a while.
            patch.setattr("retropole.io.live.dds.QUIET", 0.0)
            if "no longer published" in right.waits_for:
                break
        time.sleep(0.1)
    else:
        raise AssertionError(right.waits_for)
    right.close()


def test_one_that_is_started_again_is_heard_also_with_another_reliability() -> None:
    source = source_of("/front/points")
    with published("/front/points", "--points", "100"):
        first(source)
    with published("/front/points", "--points", "200", "--best-effort", "--frame", "other"):
        frame = first(source, lambda frame: frame.frame_id == "other")
        assert len(frame.cloud) == 200
    source.close()


def test_garbage_is_an_error_and_it_goes_on() -> None:
    source = source_of("/front/points")
    good, bad = 0, list[str]()
    with published("/front/points", "--points", "300", "--garbage"):
        for _ in range(600):
            try:
                good += source.newest(0.1) is not None
            except ReadError as error:
                bad.append(str(error))
            if min(good, len(bad)) > 2:
                break
    source.close()
    assert good > 2
    assert len(bad) > 2
    assert all("do not fit" in each for each in bad)


def test_another_clock_is_noted() -> None:
    source = source_of("/front/points")
    with published("/front/points", "--points", "100", "--behind", "3600"):
        (note,) = first(source).cloud.notes
    source.close()
    assert "3.6e+03 s behind" in note


def test_only_the_newest_is_given() -> None:
    source = source_of("/front/points")
    with published("/front/points", "--points", "100"):
        first(source)
        before = time.time()
        time.sleep(1.5)
        # Ten were sent meanwhile; the one that is given is no old one.
        frame = first(source)
        assert frame.stamp is not None
        assert frame.stamp >= before + 1.5
    source.close()


def test_a_domain_is_a_small_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    assert domain_or_default(None) == 7
    assert domain_or_default(3) == 3
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(UsageError, match="0 to 232"):
        domain_or_default(None)
    with pytest.raises(UsageError, match="no network interface"):
        DdsSource("/a", domain=DOMAIN + 1, interface="nowhere0")


def test_types_are_named_as_ros_names_them_in_dds() -> None:
    assert dds_name("sensor_msgs/msg/PointCloud2") == "sensor_msgs::msg::dds_::PointCloud2_"
