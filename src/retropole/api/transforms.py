"""Transforms in the formats of other programs, for whoever converts them; no step is loaded."""

from ..export import (
    FORMATS,
    TREE_FORMATS,
    Transform,
    inverted,
    put_into_urdf,
    read_transform,
    read_tree,
    read_verdict,
)
from ..export.recording import write_transforms

__all__ = [
    "FORMATS",
    "TREE_FORMATS",
    "Transform",
    "inverted",
    "put_into_urdf",
    "read_transform",
    "read_tree",
    "read_verdict",
    "write_transforms",
]
