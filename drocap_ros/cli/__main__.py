"""``python -m drocap_ros.cli`` is ``drocap``."""

from drocap_ros.cli import main

raise SystemExit(main())
