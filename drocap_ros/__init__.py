"""Human motion capture with one drone, as a ROS 2 package.

The algorithms (``reconstruction``, ``perception``, ``flight``, ``recording``) are functions of arrays and
never import ROS; only ``nodes`` and ``bringup`` do.  ``docs/api.md`` describes the functions named here.
"""

from importlib import import_module
from pkgutil import extend_path
from typing import Any

# The generated messages (drocap_ros.msg) are installed beside the Python sources by CMake.  When the
# source tree comes first on the path, the search has to go on to the installed copy to find them.
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"
__all__ = ["compare", "export", "load_motion", "reconstruct"]

#: Function -> its module, imported on first use.
_MODULES = {"compare": "api", "reconstruct": "api", "load_motion": "motion"}


def __getattr__(name: str) -> Any:
    """Import a function of the package on first use; the room ``export`` is callable itself."""
    if name == "export":
        return import_module("drocap_ros.export")
    if name in _MODULES:
        return getattr(import_module(f"drocap_ros.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
