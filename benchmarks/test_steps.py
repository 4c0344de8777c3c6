"""Time of each step of the method on one simulated street, by pytest-benchmark.

pip install -e ".[bench]" && pytest benchmarks/test_steps.py
pytest benchmarks/test_steps.py --benchmark-autosave
pytest-benchmark compare
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from retropole.adjustment.refinement import refine
from retropole.alignment.adjustment import align_beams
from retropole.alignment.observations import beams_of
from retropole.base import se3
from retropole.base.datatypes import Calibration
from retropole.checking.metrics import RQE_POINTS, rqe
from retropole.extraction.poles import extract_poles
from retropole.hypotheses.correspondence import match_poles
from retropole.pipeline import calibrate
from retropole.report import render_report
from retropole.result import InputDoc, RunConfig, result_document
from retropole.simulation import SimulatedPair, simulate_pair
from retropole.surfaces.visibility import score_hypotheses


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """As `calibrate` sets it for its steps."""
    with threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def pair() -> SimulatedPair:
    return simulate_pair("street", np.random.default_rng(0))


@pytest.fixture(scope="module")
def answer(pair: SimulatedPair) -> Calibration:
    return calibrate(pair.target, pair.source)


def test_extract(benchmark: Any, pair: SimulatedPair) -> None:
    benchmark(extract_poles, pair.target)


def test_match(benchmark: Any, answer: Calibration) -> None:
    placement = answer.placements[0]
    benchmark(match_poles, placement.target.poles, placement.source.poles)


def test_disambiguate(benchmark: Any, pair: SimulatedPair, answer: Calibration) -> None:
    matches = [h.match for h in answer.hypotheses]
    benchmark(score_hypotheses, pair.target, pair.source, matches)


def test_align(benchmark: Any, pair: SimulatedPair, answer: Calibration) -> None:
    match, placement = answer.hypotheses[0].match, answer.placements[0]
    target = beams_of([(placement.target.poles[i], pair.target) for i, _ in match.pairs])
    source = beams_of([(placement.source.poles[j], pair.source) for _, j in match.pairs])
    benchmark(align_beams, target, source, match.T_target_source, radius=0.02)


def test_refine(benchmark: Any, pair: SimulatedPair, answer: Calibration) -> None:
    assert answer.poles is not None
    benchmark(refine, pair.target, pair.source, answer.poles)


def test_calibrate(benchmark: Any, pair: SimulatedPair) -> None:
    benchmark(calibrate, pair.target, pair.source)


def test_entropy(benchmark: Any, pair: SimulatedPair) -> None:
    together = [pair.target.xyz, se3.apply(pair.T_target_source, pair.source.xyz)]
    xyz = np.random.default_rng(0).permutation(np.concatenate(together))[:RQE_POINTS]
    benchmark(rqe, xyz)


def test_report(benchmark: Any, answer: Calibration) -> None:
    inputs = [InputDoc(f"{name}.pcd", "0" * 64, 0, 0, "auto", None) for name in ("a", "b")]
    document = result_document(answer, inputs=inputs, config=RunConfig(), seconds={})
    benchmark(render_report, document, answer.placements)
