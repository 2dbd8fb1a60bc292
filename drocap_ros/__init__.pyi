"""Types of the names that `drocap_ros/__init__.py` imports on first use."""

from drocap_ros.api import compare as compare
from drocap_ros.api import reconstruct as reconstruct
from drocap_ros.export import export as export
from drocap_ros.motion import load_motion as load_motion

__version__: str
