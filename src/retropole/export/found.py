"""What a reader found in a file, before one transform of it is chosen."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from ..base.datatypes import Array
from ..base.errors import ReadError
from ..base.se3 import rigid
from .transform import Transform


class Found(NamedTuple):
    """A transform in a file.

    Attributes
    ----------
    parent, child
        Names of its frames in the file; None where the file names none.
    pose
        Gives ``T_parent_child`` (4, 4). Called for the chosen one alone, so that nothing that is
        wrong elsewhere in a file is in the way.
    covariance
        (6, 6) over ``[φ, δ]``, axes of the parent, or None.
    roles
        As in `Transform`.
    """

    parent: str | None
    child: str | None
    pose: Callable[[], Array]
    covariance: Array | None = None
    roles: tuple[str, str] = ("target", "source")


def choose(found: Sequence[Found], parent: str | None, child: str | None) -> Transform:
    """Take the one transform that fits the names; name it where the file does not.

    Raises
    ------
    ReadError
        Where none fits, several do, or the one is no rigid transform.
    """
    fits = [f for f in found if _fits(f.parent, parent) and _fits(f.child, child)]
    if len(fits) != 1:
        listed = ", ".join(f"{f.parent or 'unnamed'} -> {f.child or 'unnamed'}" for f in found[:20])
        wanted = f"{parent or 'any parent'} -> {child or 'any child'}"
        raise ReadError(
            f"{len(fits)} transforms fit {wanted}, one is needed; the file holds: "
            f"{listed or 'none'} (parent -> child); name both frames as the file does"
        )
    one = fits[0]
    return Transform(
        rigid(one.pose()),
        one.parent or parent or one.roles[0],
        one.child or child or one.roles[1],
        one.covariance,
        one.roles,
    )


def _fits(in_file: str | None, wanted: str | None) -> bool:
    return in_file is None or wanted is None or in_file == wanted
