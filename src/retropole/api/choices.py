"""What a user may choose from, without loading what works with it: a command lists it in its help.

Methods that `compare` runs, formats of transforms and of a whole site's frames, and the movements
that a check must not miss where nothing else is asked for.
"""

from ..evaluation.methods import ALL_METHODS, OURS
from ..evaluation.rivals import RIVALS
from ..export import FORMATS, TREE_FORMATS
from ..monitoring.tolerance import DEFAULT_TOLERANCE, WIDEST_TOLERANCE

__all__ = [
    "ALL_METHODS",
    "DEFAULT_TOLERANCE",
    "FORMATS",
    "OURS",
    "RIVALS",
    "TREE_FORMATS",
    "WIDEST_TOLERANCE",
]
