"""Human motion capture with one drone, as a ROS 2 package.

The algorithms (``reconstruction``, ``perception``, ``flight``, ``recording``) are functions of arrays and
never import ROS; only ``nodes`` and ``bringup`` do.
"""

from pkgutil import extend_path

# The generated messages (drocap_ros.msg) are installed beside the Python sources by CMake.  When the
# source tree comes first on the path, the search has to go on to the installed copy to find them.
__path__ = extend_path(__path__, __name__)

__version__ = "0.1.0"
