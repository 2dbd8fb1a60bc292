"""``python -m drocap_ros.nodes NAME``: a node as a process."""

from __future__ import annotations

import sys

from drocap_ros.errors import InputError
from drocap_ros.ros.processes import node_class
from drocap_ros.ros.spin import node_main
from drocap_ros.ros.topics import NODES


def main(name: str) -> int:
    """Run the named node; returns the exit status."""
    return node_main(node_class(name))


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in NODES:
        print(f"drocap: expected the name of a node: {', '.join(NODES)}; its --help lists its parameters")
        raise SystemExit(InputError.exit_status)
    raise SystemExit(main(sys.argv.pop(1)))
