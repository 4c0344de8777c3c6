"""Result documents that hold nothing but what a test needs."""

from pathlib import Path

from retropole.base.bounded import Status
from retropole.base.datatypes import Array
from retropole.result import PolesDoc, ReasonDoc, ResultDoc, RunConfig, StagesDoc, encode


def result_of(
    status: Status,
    reasons: list[ReasonDoc],
    pose: Array | None = None,
    covariance: Array | None = None,
) -> ResultDoc:
    """Make a document of what is given, and of nothing else."""
    return ResultDoc(
        status=status,
        reasons=reasons,
        T_target_source=pose,
        covariance=covariance,
        predicted_error=None,
        stages=StagesDoc(None, None),
        hypotheses=[],
        margin=None,
        poles=PolesDoc([], []),
        inputs=[],
        config=RunConfig(),
        version="0",
        created="",
        seconds={},
    )


def write_result(
    folder: Path,
    status: Status,
    reasons: list[ReasonDoc],
    pose: Array | None = None,
    covariance: Array | None = None,
) -> Path:
    """Write ``result.json`` and say where it is."""
    path = folder / "result.json"
    path.write_bytes(encode(result_of(status, reasons, pose, covariance)))
    return path
