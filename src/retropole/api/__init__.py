"""What ``import retropole as rp`` gives: the steps for users, from paths, arrays or clouds.

`retropole` itself looks the names up when they are used, so that each costs only one module. Here
is what all of these load, for further computation with their answers: the kinds of arrays, rigid
transforms (`se3`), numbers in words (`quantities`), what a reason code means (`explain`), and the
least uncertainty of any answer (`floor`).
"""

from ..base import quantities, se3
from ..base.datatypes import Array, BoolArray, IntArray
from ..base.reasons import explain
from ..base.uncertainty import floor

__all__ = ["Array", "BoolArray", "IntArray", "explain", "floor", "quantities", "se3"]
