"""What a user may choose from, without loading what works with it: a command lists it in its help.

Methods that `compare` runs, and the movements that a check must not miss where nothing else is
asked for.
"""

from ..evaluation.rivals import ALL_METHODS, OURS, RIVALS
from ..monitoring.tolerance import DEFAULT_TOLERANCE, WIDEST_TOLERANCE

__all__ = [
    "ALL_METHODS",
    "DEFAULT_TOLERANCE",
    "OURS",
    "RIVALS",
    "WIDEST_TOLERANCE",
]
