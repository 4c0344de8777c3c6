"""What a user may choose from, without loading what works with it: a command lists it in its help.

Methods that `evaluate` runs, what a watch listens to, and the movements that a check must not miss
by default.
"""

from ..checking.methods import ALL_METHODS as ALL_METHODS
from ..checking.methods import OURS as OURS
from ..checking.methods import RIVALS as RIVALS
from ..checking.tolerance import DEFAULT_TOLERANCE as DEFAULT_TOLERANCE
from ..checking.tolerance import WIDEST_TOLERANCE as WIDEST_TOLERANCE
from ..io.live import SOURCE_KINDS as SOURCE_KINDS
