"""Transforms in the formats of other programs, for whoever converts them; no step is loaded."""

from ..export import FORMATS as FORMATS
from ..export import TREE_FORMATS as TREE_FORMATS
from ..export import Transform as Transform
from ..export import inverted as inverted
from ..export import mounted as mounted
from ..export import put_into_robot as put_into_robot
from ..export import read_mounting as read_mounting
from ..export import read_transform as read_transform
from ..export import read_tree as read_tree
from ..export import read_verdict as read_verdict
from ..export.recording import write_transforms as write_transforms
